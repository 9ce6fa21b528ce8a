"""Effect of the error of a calibration on tips in the phantom.

The two rays of a wrong calibration still meet, but elsewhere: only this computation, or a target of
known place, reveals the error.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from needle_core.errors import UserError
from needle_tracker.calibrating.calibration_session import BoardView, Corners, Place
from needle_tracker.calibrating.rig_model import RigModel
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.optics.refraction import stereo_views
from needle_tracker.stereo.triangulation import midpoint

Array = NDArray[np.float64]

# Region of the needle in `rig` [m]: across z, along z, and behind the windows.
HALF_HEIGHT, HALF_WIDTH = 0.0155, 0.015
INSERTIONS = (0.005, 0.120)
LEAST_DEPTH = 1e-3
_DRAWS = 400
_SEED = 0


def needle_points(
    calibration: StereoCalibration, counts: tuple[int, int, int] = (4, 3, 5)
) -> Array:
    """Return a grid of points in the region of the needle, shape (n, 3), in `rig` [m].

    Parameters
    ----------
    calibration : StereoCalibration
        The points are behind both windows.
    counts : tuple of int
        Points along x, y and z, before those outside are removed.

    Raises
    ------
    UserError
        No point is behind both windows.
    """
    axes = (
        np.linspace(HALF_HEIGHT, -HALF_HEIGHT, counts[0]),
        np.linspace(-HALF_WIDTH, HALF_WIDTH, counts[1]),
        np.linspace(*INSERTIONS, counts[2]),
    )
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    for camera in (calibration.left, calibration.right):
        points = points[camera.window.depth(points) >= LEAST_DEPTH]
    if not len(points):
        raise UserError("the needle's axis, z of rig, is not in the phantom behind both windows")
    return points


def tip_shifts(assumed: StereoCalibration, true: StereoCalibration) -> Array:
    """Return the errors of tips, shape (n, 3), in `rig` [m].

    Parameters
    ----------
    assumed : StereoCalibration
        Calibration of the triangulation.
    true : StereoCalibration
        True calibration.
    """
    points = needle_points(true)
    left, right = (view.project(points) for view in stereo_views(true))
    return measured_points(assumed, left, right) - points


def measured_points(assumed: StereoCalibration, left: Array, right: Array) -> Array:
    """Return the points of pairs of pixels by a calibration, shape (n, 3), in `rig` [m].

    Parameters
    ----------
    assumed : StereoCalibration
        Calibration of the triangulation.
    left, right : ndarray, shape (n, 2)
        Pixels of the two cameras.
    """
    views = stereo_views(assumed)
    return np.stack([midpoint(views, pair) for pair in zip(left, right, strict=True)])


def tip_error_p95(
    calibration: StereoCalibration, covariance: Array, *, tied: bool = False
) -> float:
    """Return the 95 % error of tips from the uncertainty of a calibration [m].

    Parameters
    ----------
    calibration : StereoCalibration
        The calibration.
    covariance : ndarray, shape (s, s)
        Covariance of the parameters that all views share (`RigModel.names`).
    tied : bool
        Whether the relative pose of the cameras is fixed.
    """
    generator = np.random.default_rng(_SEED)
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    draws = generator.standard_normal((_DRAWS, len(covariance))) @ root.T
    shifts = np.einsum("nij,dj->dni", _tip_slopes(calibration, tied=tied), draws)
    return float(np.percentile(np.linalg.norm(shifts, axis=-1), 95.0))


def _tip_slopes(calibration: StereoCalibration, *, tied: bool) -> Array:
    """Return d(tip)/d(shared parameters), shape (points, 3, s).

    The pixels are constant: J_tip d(tip) + J_parameters d(parameters) = 0, by least squares.
    """
    points = needle_points(calibration)
    nowhere = Corners(points, np.zeros((len(points), 2)))
    view = BoardView("", Place(np.eye(4), under_surface=True), nowhere, nowhere)
    model = RigModel(calibration, [view], np.eye(4)[None], tied=tied)
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
