"""Errors of tips after a rig that is known was calibrated from a board's noisy corners."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from needle_sim.camera.optics import project
from needle_sim.camera.stereo_rig import StereoRig, load_stereo_rig
from needle_tracker.calibrating.calibration_session import BoardView, Corners, Place
from needle_tracker.calibrating.charuco import CharucoBoard
from needle_tracker.calibrating.rig_calibration import calibrate
from needle_tracker.calibrating.rig_model import measured_points, needle_points
from needle_tracker.optics.calibration import load_calibration, surface_from_above

Array = NDArray[np.float64]

BOARD = CharucoBoard()
_FREE = 20
_THICKNESS = 1e-3  # of the board [m]
_PLACED = 2e-5  # how well the places under the surface are known (one sigma) [m]
_TABLE_INDEX = 1.33  # what is given for the phantom's index, to be found better
_BORDER_PX = 5.0
# T_rig_board of a board face up: its columns run along z, its rows along y.
_FACE_UP = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])


def calibrated_tip_errors(calibration: Path, seed: int, corner_sigma: float) -> Array:
    """Return how far tips are off that a calibration from noisy corners measures without noise.

    The set is the one that `docs/calibration.md` asks for. The corners come from the simulation's
    own projection.

    Parameters
    ----------
    calibration : Path
        The rig as it is.
    seed : int
        Of the corners' noise, the poses held by hand and the places' errors.
    corner_sigma : float
        Standard deviation of each coordinate of a corner [px].

    Returns
    -------
    ndarray, shape (n,)
        Distances [m] at points all over where the needle goes.
    """
    rig = load_stereo_rig(calibration)
    rng = np.random.default_rng(seed)
    views = []
    for i in range(_FREE):
        left, right = _corners(rig, _held(rng), rng, corner_sigma)
        views.append(BoardView(f"free_{i:02d}", None, left, right))
    for name, place in _places(rig.half_height).items():
        pose = _as_it_lies(place, rng) if place.under_surface else place.T_rig_board
        left, right = _corners(rig, pose, rng, corner_sigma)
        views.append(BoardView(name, place, left, right))
    sizes = {
        side: (camera.image_width, camera.image_height)
        for side, camera in (("left", rig.left), ("right", rig.right))
    }
    surface = surface_from_above(rig.half_height, _TABLE_INDEX)
    found = calibrate(views, sizes, (surface, surface)).calibration
    points = needle_points(load_calibration(calibration))
    left_pixels, right_pixels = (project(points, camera) for camera in (rig.left, rig.right))
    tips = measured_points(found, left_pixels, right_pixels)
    return np.asarray(np.linalg.norm(tips - points, axis=1))


def _corners(
    rig: StereoRig, pose: Array, rng: np.random.Generator, corner_sigma: float
) -> tuple[Corners, Corners]:
    """Return the corners that the left and the right camera see of a board, each with its error."""
    seen = []
    for camera in (rig.left, rig.right):
        exact = project(BOARD.corners @ pose[:3, :3].T + pose[:3, 3], camera)
        pixels = exact + rng.normal(0.0, corner_sigma, exact.shape)
        most = np.array([camera.image_width, camera.image_height]) - _BORDER_PX
        inside = np.all((pixels > _BORDER_PX) & (pixels < most), axis=1)
        seen.append(Corners(BOARD.corners[inside], pixels[inside]))
    return seen[0], seen[1]


def _flat(origin: tuple[float, float, float], pitch: float = 0.0) -> Array:
    """Return T_rig_board of a board face up, its first corner there; pitched about y [rad]."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", pitch).as_matrix() @ _FACE_UP
    pose[:3, 3] = origin
    return pose


def _held(rng: np.random.Generator) -> Array:
    """Return T_rig_board of a board held above the phantom, tilted any way by 15 to 42 degrees."""
    pose = np.eye(4)
    axis, tilt = rng.uniform(0.0, 2.0 * np.pi), np.deg2rad(rng.uniform(15.0, 42.0))
    turn = Rotation.from_rotvec(tilt * np.array([0.0, np.cos(axis), np.sin(axis)]))
    spin = Rotation.from_euler("x", rng.uniform(-25.0, 25.0) + 180 * rng.integers(2), degrees=True)
    pose[:3, :3] = (turn * spin).as_matrix() @ _FACE_UP
    middle = np.array([BOARD.size[0] / 2.0, BOARD.size[1] / 2.0, 0.0])
    centre = rng.uniform([0.06, -0.012, 0.05], [0.10, 0.012, 0.075])
    pose[:3, 3] = centre - pose[:3, :3] @ middle
    return pose


def _places(surface: float) -> dict[str, Place]:
    """Return where the board lies: twice flat on the surface, under it deep and on a wedge."""
    wedge = np.deg2rad(12.0)
    return {
        "surface_a": Place(_flat((surface + _THICKNESS, -0.045, 0.0025))),
        "surface_b": Place(_flat((surface + _THICKNESS, -0.040, 0.0005))),
        "under_deep": Place(_flat((surface - 0.033, -0.045, 0.0025)), True, _PLACED),
        "under_wedge_a": Place(_flat((surface - 0.030, -0.045, 0.004), wedge), True, _PLACED),
        "under_wedge_b": Place(_flat((surface - 0.006, -0.045, 0.004), -wedge), True, _PLACED),
    }


def _as_it_lies(place: Place, rng: np.random.Generator) -> Array:
    """Return T_rig_board of a board as it really lies: its place is known that well only."""
    pose = np.array(place.T_rig_board, dtype=np.float64)
    turn = Rotation.from_rotvec(rng.normal(0.0, 2.0 * place.sigma / BOARD.size[0], 3))
    pose[:3, :3] = turn.as_matrix() @ pose[:3, :3]
    pose[:3, 3] += rng.normal(0.0, place.sigma, 3)
    return pose
