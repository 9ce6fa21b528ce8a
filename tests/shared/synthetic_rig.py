"""Rigs with known parameters, by the simulation's optics, and boards in front of them."""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from needle_sim.camera.optics import project
from needle_sim.camera.stereo_rig import SimulatedCamera, StereoRig
from needle_tracker.calibrating.calibration_session import HELD_FREELY, BoardView, Corners, Place
from needle_tracker.calibrating.charuco import CharucoBoard
from needle_tracker.optics.calibration import (
    SIDES,
    Layer,
    StereoCalibration,
    Window,
    surface_from_above,
)

Array = NDArray[np.float64]

BOARD = CharucoBoard(9, 6, 0.0135, 0.010)
BOX_BOARD = CharucoBoard(columns=12, rows=5, square=0.008, marker=0.006)
SMALL = CharucoBoard(5, 4, dictionary="DICT_4X4_50")
SIZES = dict.fromkeys(SIDES, (1024, 768))
NOISE_PX = 0.03
GIVEN = (surface_from_above(0.0175, 1.33),) * 2
"""Phantom of a session file, through which both cameras look."""
_WALL = (Layer(5e-3, 1.49),)
GIVEN_BOX = (
    # As measured by ruler and data sheet: faces to a millimetre, level and plumb.
    Window(np.array([0.0235, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]), _WALL, 1.34),
    Window(np.array([0.0, 0.059, 0.0]), np.array([0.0, 1.0, 0.0]), _WALL, 1.34),
)


def session_content(**places: Any) -> dict[str, Any]:
    """Return the content of a session file."""
    phantom = {"surface_height": 0.0175, "refractive_index": 1.33}
    return {"board": dataclasses.asdict(BOARD), "phantom": phantom, "places": places}


def lenses_of(calibration: StereoCalibration) -> StereoCalibration:
    """Return both cameras at the origin: only their lenses are known."""
    left, right = (
        dataclasses.replace(camera, T_optical_rig=np.eye(4))
        for camera in (calibration.left, calibration.right)
    )
    return StereoCalibration(left, right)


def changed(rig: StereoRig, side: str, **values: Any) -> StereoRig:
    """Return a rig with one camera changed."""
    camera = dataclasses.replace(getattr(rig, side), **values)
    return dataclasses.replace(rig, **{side: camera})


def turned(rig: StereoRig, side: str, degrees: float, axis: str = "y") -> StereoRig:
    """Return a rig with one camera turned about an axis of its optical frame."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return changed(rig, side, T_optical_rig=turn @ getattr(rig, side).T_optical_rig)


def with_window(rig: StereoRig, **values: Any) -> StereoRig:
    """Return a rig with another surface for both cameras."""
    window = dataclasses.replace(rig.left.window, **values)
    return changed(changed(rig, "left", window=window), "right", window=window)


def pixels_of(camera: SimulatedCamera, points: Array, under: bool) -> Array:
    """Return the pixels of points in rig; `under`: through the window."""
    if under:
        return project(points, camera)
    pose = camera.T_optical_rig
    turn = cv2.Rodrigues(pose[:3, :3])[0]
    pixels = cv2.projectPoints(points, turn, pose[:3, 3], camera.camera_matrix, camera.distortion)
    return np.asarray(pixels[0], dtype=np.float64).reshape(-1, 2)


def view_of(
    rig: StereoRig,
    name: str,
    pose: Array,
    place: Place,
    rng: np.random.Generator,
    noise: float = NOISE_PX,
    board: CharucoBoard = BOARD,
) -> BoardView:
    """Return the board's corners inside both images, with noise."""
    points, found = board.corners, []
    for camera in (rig.left, rig.right):
        moved = points @ pose[:3, :3].T + pose[:3, 3]
        pixels = pixels_of(camera, moved, place.under_surface)
        pixels = pixels + rng.normal(0.0, noise, pixels.shape)
        end = np.array([camera.image_width, camera.image_height]) - 5
        inside = np.all((pixels > 5) & (pixels < end), axis=1)
        found.append(Corners(points[inside], pixels[inside]))
    return BoardView(name, place, *found)


def flat_pose(origin: Any, pitch_deg: float = 0.0) -> Array:
    """Return T_rig_board of a board face up: columns along z, rows along y; then pitched."""
    pose = np.eye(4)
    flat = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    pose[:3, :3] = Rotation.from_euler("y", pitch_deg, degrees=True).as_matrix() @ flat
    pose[:3, 3] = origin
    return pose


def held(turn: Rotation, up: Array, middle: Array, board: CharucoBoard = BOARD) -> Array:
    """Return T_rig_board of a board with its print towards `up`, columns along z, then turned."""
    pose = np.eye(4)
    z = np.array([0.0, 0.0, 1.0])
    pose[:3, :3] = turn.as_matrix() @ np.stack([z, np.cross(-up, z), -up], axis=-1)
    half = 0.5 * board.square * np.array([board.columns, board.rows, 0.0])
    pose[:3, 3] = middle - pose[:3, :3] @ half
    return pose


def _tilt(
    up: Array, tilts_deg: tuple[float, float], spin: float, rng: np.random.Generator
) -> Rotation:
    across = np.cross([0.0, 0.0, 1.0], up)
    tilt, about = np.deg2rad(rng.uniform(*tilts_deg)), rng.uniform(0, 2 * np.pi)
    axis = np.cos(about) * across + np.sin(about) * np.array([0.0, 0.0, 1.0])
    turn: Rotation = Rotation.from_rotvec(tilt * axis) * Rotation.from_rotvec(np.deg2rad(spin) * up)
    return turn


def free_pose(
    rng: np.random.Generator,
    tilts_deg: tuple[float, float] = (15, 42),
    board: CharucoBoard = BOARD,
) -> Array:
    """Return a tilted board pose in the working volume, with its centre in both views."""
    middle, up = rng.uniform([0.06, -0.012, 0.05], [0.10, 0.012, 0.075]), np.eye(3)[0]
    spin = rng.uniform(-25, 25) + 180 * rng.integers(2)
    return held(_tilt(up, tilts_deg, spin, rng), up, middle, board)


PLACES = {
    # Flat on the surface, twice; under it deep and flat, and on a wedge.
    "surface_a": Place(flat_pose([0.0185, -0.045, 0.0025])),
    "surface_b": Place(flat_pose([0.0185, -0.040, 0.0005])),
    "under_deep": Place(flat_pose([-0.0155, -0.045, 0.0025]), True, 2e-5),
    "under_wedge": Place(flat_pose([-0.0125, -0.045, 0.004], 12.0), True, 2e-5),
    "under_wedge_b": Place(flat_pose([0.0115, -0.045, 0.004], -12.0), True, 2e-5),
}
_DIAGONAL = np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0)
_MIDDLE = np.array([0.0, 0.0, 0.0625])
STANDS = Place(held(Rotation.identity(), _DIAGONAL, _MIDDLE, BOX_BOARD), under_surface=True)
"""Place of the board in the box: half-way between both views, about the needle's axis."""
IN_BOX = Place(np.eye(4), under_surface=True, sigma=np.inf)


def scatter(place: Place, rng: np.random.Generator) -> Array:
    """Return the true pose of a place, which is known only to its sigma."""
    pose: Array = place.T_rig_board.copy()
    turn = Rotation.from_rotvec(rng.normal(0.0, 2 * place.sigma / 0.12, 3))
    pose[:3, :3] = turn.as_matrix() @ pose[:3, :3]
    pose[:3, 3] += rng.normal(0.0, place.sigma, 3)
    return pose


def take(
    rig: StereoRig,
    seed: int = 0,
    free: int = 6,
    places: dict[str, Place] = PLACES,
    noise: float = NOISE_PX,
    board: CharucoBoard = BOARD,
) -> list[BoardView]:
    """Return the views of a calibration session; `places` are those of the session file."""
    rng = np.random.default_rng(seed)
    poses: list[tuple[str, Array, Place]] = [
        (f"free_{i:02d}", free_pose(rng, board=board), HELD_FREELY) for i in range(free)
    ]
    poses += [(name, scatter(place, rng), place) for name, place in places.items()]
    return [view_of(rig, name, pose, place, rng, noise, board) for name, pose, place in poses]


def take_in_box(
    rig: StereoRig, air: int = 12, box: int = 3, seed: int = 0, noise: float = NOISE_PX
) -> list[BoardView]:
    """Return boards in front of the windows in turn, one standing in the box, some held in it."""
    rng = np.random.default_rng(seed)
    poses: list[tuple[str, Array, Place]] = []
    for i in range(air):
        up, across = np.eye(3)[i % 2], np.eye(3)[1 - i % 2]
        away = rng.uniform(0.07, 0.20) + 0.04 * (i % 2)
        middle = away * up + rng.uniform(-0.03, 0.03) * across
        middle[2] += rng.uniform(0.035, 0.09)
        turn = _tilt(up, (25.0, 50.0), rng.uniform(-60.0, 60.0), rng)
        poses.append((f"air_{i:02d}", held(turn, up, middle, BOX_BOARD), HELD_FREELY))
    poses.append(("stand", STANDS.T_rig_board, STANDS))
    for i in range(box):
        turn = Rotation.from_rotvec(np.deg2rad(rng.uniform(-12.0, 12.0, 3)))
        middle = rng.uniform([-0.001, -0.012, 0.05], [0.001, 0.008, 0.075])
        poses.append((f"box_{i:02d}", held(turn, _DIAGONAL, middle, BOX_BOARD), IN_BOX))
    return [view_of(rig, name, pose, place, rng, noise, BOX_BOARD) for name, pose, place in poses]


def board_image(board: CharucoBoard, square_px: int, margin: int = 0) -> NDArray[np.uint8]:
    """Return the pattern with a white margin."""
    return np.pad(board.drawing(square_px), margin, constant_values=255)
