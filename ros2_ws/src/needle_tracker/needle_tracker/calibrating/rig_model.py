"""Model of the whole rig: pixels of all corners as a function of cameras, surface and boards.

Calibration and check share this model and its estimate of tip errors in the phantom: with a wrong
calibration, the two rays still meet, but elsewhere. The model's parameters are one vector:

    left: fx fy cx cy k1 k2 p1 p2 k3, rotation (3), translation (3); right: likewise;
    error of the size of the squares; windows; for each view of the board: rotation (3),
    translation (3).

The window parameters are the refractive index and height of a common surface, or else, for each
window, its offset along the normal and its tilts about two axes perpendicular to it; layers and
indices then keep their given values.

Rotations and translations are increments on the initial transforms. A camera rotates about its own
centre, T_optical_rig = [exp(rotation) | translation] T0; a board about its
first corner, T_rig_board = [exp(rotation) R0 | t0 + translation].
"""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from needle_core.errors import UserError
from needle_tracker.calibrating.calibration_session import BoardView, Corners, Place
from needle_tracker.optics.calibration import (
    SIDES,
    Camera,
    StereoCalibration,
    Window,
    pose_matrix,
    surface_from_above,
)
from needle_tracker.optics.refraction import RefractedCamera, stereo_views
from needle_tracker.stereo.triangulation import locate

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
POSE = ("rx", "ry", "rz", "tx", "ty", "tz")
SURFACE = ("refractive_index", "surface_height")
# Standard deviations of a given window, as measured with a ruler and a level [m, rad].
WINDOW = {"window_offset": 2e-3, "window_tilt_1": 0.02, "window_tilt_2": 0.02}
_CAMERA = len(LENS) + len(POSE)
SQUARES = 2 * _CAMERA
FIRST_WINDOW = SQUARES + 1
# Steps of the central differences, whose relative error is about 1e-6.
_STEPS = {"f": 0.1, "c": 0.1, "k": 1e-4, "p": 1e-4, "r": 1e-5, "t": 1e-5, "s": 1e-5, "w": 1e-5}

# Region of the needle in `rig` [m]: across z, along z, and behind the windows.
HALF_HEIGHT, HALF_WIDTH = 0.0155, 0.015
INSERTIONS = (0.005, 0.120)
LEAST_DEPTH = 1e-3
_BEYOND = 10.0  # farther than any board in air [m]
_DRAWS = 400
_SEED = 0


def camera_slice(side: str) -> slice:
    """Return the slice of the parameters of a camera."""
    start = SIDES.index(side) * _CAMERA
    return slice(start, start + _CAMERA)


def unit_of(name: str) -> tuple[float, str]:
    """Return the factor to the display unit of a parameter or a rotation, and that unit."""
    if "tilt" in name or "turned" in name:
        return math.degrees(1.0), "deg"
    return (1e3, "mm") if name.endswith(("surface_height", "window_offset")) else (1.0, "")


class RigModel:
    """Projection of all views, and its derivatives.

    Parameters
    ----------
    start : StereoCalibration
        Initial cameras and windows.
    views : list of BoardView
        Views of the board.
    tied : bool
        Whether the relative pose of the cameras is fixed; rotation and translation of the right
        camera are then unused.

    Attributes
    ----------
    names : tuple of str
        Names of the parameters that all views share, such as `left.fx`; they come first.
    shared : int
        Number of shared parameters.
    pixels : ndarray, shape (n, 2)
        Measured corners, those of the left camera first [px].
    view_of : ndarray of int, shape (n,)
        Number of the view of each corner.
    seen_by : dict of str to ndarray of bool, shape (n,)
        Corners of each camera.
    start : ndarray, shape (p,)
        Initial parameters.
    given_sigma : ndarray, shape (p,)
        Standard deviations of the initial parameters as given: 0 for the board at an exact place,
        infinite for an unknown parameter.
    """

    def __init__(
        self, start: StereoCalibration, views: list[BoardView], *, tied: bool = False
    ) -> None:
        self.views, self.tied = views, tied
        self._start, self._surface = start, start.surface
        cameras = tuple(f"{side}.{name}" for side in SIDES for name in LENS + POSE)
        own = tuple(f"{side}.{name}" for side in SIDES for name in WINDOW)
        windows = own if self._surface is None else SURFACE
        self.names = (*cameras, "square_size", *windows)
        self.shared = len(self.names)
        self._boards = initial_board_poses(start, views)
        corners = [view.corners(side) for side in SIDES for view in views]
        self._points = np.concatenate([one.points for one in corners])
        self.pixels = np.concatenate([one.pixels for one in corners])
        numbers = np.arange(len(corners)).repeat([len(one.points) for one in corners])
        side_of, self.view_of = np.divmod(numbers, len(views))
        self.seen_by = {side: side_of == number for number, side in enumerate(SIDES)}
        self._under = np.array([view.place.under_surface for view in views])[self.view_of]
        self.start = np.zeros(self.shared + 6 * len(views))
        for side, camera in start.cameras.items():
            lens = [*camera.camera_matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *camera.distortion]
            self.start[camera_slice(side)][: len(LENS)] = lens
        if self._surface is not None:
            height = self._surface.point[0]
            self.start[FIRST_WINDOW : self.shared] = self._surface.inside, height
        windows_sigma = [WINDOW.get(name.split(".")[-1], np.inf) for name in self.names]
        boards_sigma = [_place_sigma(view) for view in views]
        self.given_sigma = np.concatenate([windows_sigma, *boards_sigma])
        names = [*self.names, *POSE * len(views)]
        self._steps = np.array([_STEPS[name.split(".")[-1][0]] for name in names])

    def calibration(self, parameters: Array) -> StereoCalibration:
        """Return the calibration of a parameter vector."""
        cameras: list[Camera] = []
        for number, (side, start) in enumerate(self._start.cameras.items()):
            fx, fy, cx, cy, *lens = parameters[camera_slice(side)][: len(LENS)]
            matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
            if cameras and self.tied:
                from_left = start.T_optical_rig @ np.linalg.inv(self._start.left.T_optical_rig)
                transform = from_left @ cameras[0].T_optical_rig
            else:
                pose = parameters[camera_slice(side)][len(LENS) :]
                step = pose_matrix(Rotation.from_rotvec(pose[:3]).as_matrix(), pose[3:])
                transform = step @ start.T_optical_rig
            window = self._window(parameters[FIRST_WINDOW : self.shared], start.window, number)
            cameras.append(
                Camera(start.width, start.height, matrix, np.array(lens), transform, window)
            )
        return StereoCalibration(*cameras)

    def board_poses(self, parameters: Array) -> Array:
        """Return T_rig_board of each view, shape (views, 4, 4)."""
        steps = parameters[self.shared :].reshape(-1, 6)
        poses: Array = self._boards.copy()
        poses[:, :3, :3] = Rotation.from_rotvec(steps[:, :3]).as_matrix() @ poses[:, :3, :3]
        poses[:, :3, 3] += steps[:, 3:]
        return poses

    def residuals(self, parameters: Array) -> Array:
        """Return measured minus expected pixels of all corners, shape (n, 2) [px]."""
        return self.pixels - self.project(parameters)

    def project(self, parameters: Array) -> Array:
        """Return the expected pixels of all corners, shape (n, 2) [px]."""
        boards = self.board_poses(parameters)[self.view_of]
        corners = np.einsum("nij,nj->ni", boards[:, :3, :3], self._points)
        corners = (1.0 + parameters[SQUARES]) * corners + boards[:, :3, 3]
        pixels = np.empty((len(corners), 2))
        for side, camera in self.calibration(parameters).cameras.items():
            for under, seen in ((True, camera), (False, _in_air(camera))):
                chosen = self.seen_by[side] & (self._under == under)
                pixels[chosen] = RefractedCamera(seen).project(corners[chosen])
        return pixels

    def jacobian(self, parameters: Array, free: Mask) -> Array:
        """Return d(residuals)/d(free parameters), shape (2 * n, free).

        Parameters
        ----------
        parameters : ndarray, shape (p,)
            Parameters at which to differentiate.
        free : ndarray of bool, shape (p,)
            Parameters to vary.
        """
        corners = np.arange(len(self.pixels))
        result = np.zeros((len(corners), 2, len(parameters)))
        for columns in self._columns():
            if np.any(free[columns]):
                step = np.zeros_like(parameters)
                step[columns] = self._steps[columns]
                above, below = (self.project(parameters + s * step) for s in (1.0, -1.0))
                slopes = (below - above) / (2.0 * self._steps[columns][:, None])
                result[corners, :, columns] = slopes
        return result.reshape(-1, len(parameters))[:, free]

    def _columns(self) -> list[NDArray[np.intp]]:
        """Return groups of parameters that can vary at once: for each corner its own, shape (n,).

        Camera, window and board of one corner do not affect those of another.
        """
        side, both = self.seen_by["right"].astype(int), np.zeros_like(self.view_of)
        window, count = (side, len(WINDOW)) if self._surface is None else (both, len(SURFACE))
        firsts = (
            (_CAMERA * side, len(LENS)),
            (_CAMERA * (both if self.tied else side) + len(LENS), len(POSE)),
            (both + SQUARES, 1),
            (count * window + FIRST_WINDOW, count),
            (6 * self.view_of + self.shared, 6),
        )
        return [first + number for first, count in firsts for number in range(count)]

    def _window(self, parameters: Array, window: Window, number: int) -> Window:
        if self._surface is not None:
            return surface_from_above(float(parameters[1]), float(parameters[0]))
        offset, *tilt = parameters.reshape(len(SIDES), -1)[number]
        # Any two axes perpendicular to the normal.
        axes = np.linalg.svd(window.normal[None])[2][1:]
        turned = Rotation.from_rotvec(np.array(tilt) @ axes).apply(window.normal)
        return dataclasses.replace(
            window, point=window.point + offset * window.normal, normal=turned
        )


def initial_board_poses(calibration: StereoCalibration, views: list[BoardView]) -> Array:
    """Return T_rig_board of each view, shape (n, 4, 4): as given, else from one camera.

    Parameters
    ----------
    calibration : StereoCalibration
        Cameras; the windows are ignored.
    views : list of BoardView
        Views, each with the corners of at least one camera.
    """
    boards = []
    for view in views:
        if view.place.is_known:
            boards.append(view.place.T_rig_board)
            continue
        side = next(side for side in SIDES if len(view.corners(side).points))
        camera = calibration.cameras[side]
        boards.append(np.linalg.inv(camera.T_optical_rig) @ board_pose(camera, view.corners(side)))
    return np.stack(boards)


def board_pose(camera: Camera, corners: Corners) -> Array:
    """Return the pose of the board in the optical frame, shape (4, 4), without refraction."""
    _, rotation, translation = cv2.solvePnP(
        corners.points,
        corners.pixels,
        camera.camera_matrix,
        camera.distortion,
        flags=cv2.SOLVEPNP_IPPE,
    )
    turn = np.asarray(cv2.Rodrigues(np.asarray(rotation).reshape(3))[0], dtype=np.float64)
    return pose_matrix(turn, np.asarray(translation).reshape(3))


def _in_air(camera: Camera) -> Camera:
    """Return a camera with its window beyond everything that it sees."""
    window = camera.window
    beyond = window.point - _BEYOND * window.normal
    return dataclasses.replace(camera, window=dataclasses.replace(window, point=beyond))


def _place_sigma(view: BoardView) -> Array:
    """Return the standard deviations of the place of a board, shape (6,) [rad, m]."""
    if not view.place.is_known:
        return np.full(6, np.inf)
    # The sigma of the rotation follows from that of the board's edges.
    reach = max(float(np.ptp(view.left.points[:, :2], axis=0).max()), 1e-3)
    return view.place.sigma * np.repeat([2.0 / reach, 1.0], 3)


def needle_points(calibration: StereoCalibration) -> Array:
    """Return a grid of points in the region of the needle, shape (n, 3), in `rig` [m].

    Parameters
    ----------
    calibration : StereoCalibration
        Calibration whose windows bound the region: the points are behind both.

    Raises
    ------
    UserError
        No point is behind both windows.
    """
    axes = (
        np.linspace(HALF_HEIGHT, -HALF_HEIGHT, 4),
        np.linspace(-HALF_WIDTH, HALF_WIDTH, 3),
        np.linspace(*INSERTIONS, 5),
    )
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    for camera in calibration.cameras.values():
        points = points[camera.window.depth(points) >= LEAST_DEPTH]
    if not len(points):
        raise UserError("the needle's axis, z of rig, is not in the phantom behind both windows")
    return points


def tip_shift_p95(assumed: StereoCalibration, true: StereoCalibration) -> float:
    """Return the 95 % error of tips that are triangulated with an assumed calibration [m]."""
    points = needle_points(true)
    shifts = tip_errors(assumed, points, *(view.project(points) for view in stereo_views(true)))
    return float(np.percentile(np.linalg.norm(shifts, axis=-1), 95.0))


def tip_errors(assumed: StereoCalibration, points: Array, left: Array, right: Array) -> Array:
    """Return the errors of points that are triangulated from exact pixels, shape (n, 3) [m].

    Parameters
    ----------
    assumed : StereoCalibration
        Calibration of the triangulation.
    points : ndarray, shape (n, 3)
        True points in `rig` [m].
    left, right : ndarray, shape (n, 2)
        Their pixels in both images; NaN is returned where two do not determine a point.
    """
    views = stereo_views(assumed)
    errors = np.full(points.shape, np.nan)
    for i, point in enumerate(points):
        found = locate(views, np.stack([left[i], right[i]]), point)
        if found is not None:
            errors[i] = found[0] - point
    return errors


def tip_error_p95(
    calibration: StereoCalibration, covariance: Array, *, tied: bool = False
) -> float:
    """Return the 95 % error of tips from the uncertainty of a calibration [m].

    Parameters
    ----------
    calibration : StereoCalibration
        The calibration.
    covariance : ndarray, shape (p, p)
        Covariance of the parameters; only those count that all views share (`RigModel.names`).
    tied : bool
        Whether the relative pose of the cameras is fixed.
    """
    generator, slopes = np.random.default_rng(_SEED), _tip_slopes(calibration, tied=tied)
    shared = slopes.shape[-1]
    values, vectors = np.linalg.eigh(covariance[:shared, :shared])
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    draws = generator.standard_normal((_DRAWS, shared)) @ root.T
    shifts = np.einsum("nij,dj->dni", slopes, draws)
    return float(np.percentile(np.linalg.norm(shifts, axis=-1), 95.0))


def _tip_slopes(calibration: StereoCalibration, *, tied: bool) -> Array:
    """Return d(tip)/d(shared parameters), shape (points, 3, s).

    The pixels are constant: J_tip d(tip) + J_parameters d(parameters) = 0, by least squares.
    """
    points = needle_points(calibration)
    nowhere = Corners(points, np.zeros((len(points), 2)))
    view = BoardView("", Place(np.eye(4), under_surface=True), nowhere, nowhere)
    model = RigModel(calibration, [view], tied=tied)
    free = np.zeros(len(model.start), dtype=bool)
    free[: model.shared] = True
    # Residuals are measured minus expected: the sign changes twice.
    by_parameter = model.jacobian(model.start, free).reshape(2, len(points), 2, -1)
    cameras = stereo_views(calibration)
    slopes = []
    for i, point in enumerate(points):
        by_tip = np.concatenate([camera.jacobian(point) for camera in cameras])
        slopes.append(np.linalg.pinv(by_tip) @ by_parameter[:, i].reshape(4, -1))
    return np.stack(slopes)
