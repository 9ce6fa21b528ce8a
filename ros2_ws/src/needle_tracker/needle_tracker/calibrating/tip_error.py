"""What an error of the calibration does to a tip in the phantom.

The two rays of a wrong calibration still meet, somewhere else: nothing but this computation, or a
target of known place, shows it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from needle_tracker.calibrating.calibration_session import Place
from needle_tracker.calibrating.rig_model import SHARED_PARAMETERS, BoardView, Corners, RigModel
from needle_tracker.optics.calibration import SIDES, StereoCalibration
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracking.triangulation import midpoint

Array = NDArray[np.float64]

# Where the needle goes, in `rig` [m]: depth below the surface, half width, insertion.
DEPTHS = (0.002, 0.033)
HALF_WIDTH = 0.015
INSERTIONS = (0.005, 0.120)
_DRAWS = 400
_SEED = 0


def phantom_points(surface_height: float, counts: tuple[int, int, int] = (4, 3, 5)) -> Array:
    """Return a grid of points where the needle goes, shape (n, 3), in `rig` [m].

    Parameters
    ----------
    surface_height : float
        x of the surface [m].
    counts : tuple of int
        Points along x, y and z.
    """
    axes = (
        surface_height - np.linspace(*DEPTHS, counts[0]),
        np.linspace(-HALF_WIDTH, HALF_WIDTH, counts[1]),
        np.linspace(*INSERTIONS, counts[2]),
    )
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def tip_shifts(assumed: StereoCalibration, true: StereoCalibration) -> Array:
    """Return by how much tips are seen beside their place, shape (n, 3), in `rig` [m].

    Parameters
    ----------
    assumed : StereoCalibration
        What tips are triangulated with.
    true : StereoCalibration
        What the rig really is.
    """
    points = phantom_points(true.phantom.surface_height)
    left, right = (
        RefractedCamera(getattr(true, side), true.phantom).project(points) for side in SIDES
    )
    return measured_points(assumed, left, right) - points


def measured_points(assumed: StereoCalibration, left: Array, right: Array) -> Array:
    """Return the points in `rig` [m], shape (n, 3), that a calibration takes pixels for.

    Parameters
    ----------
    assumed : StereoCalibration
        What they are triangulated with.
    left, right : ndarray, shape (n, 2)
        The pixels at which each camera sees them.
    """
    views = (
        RefractedCamera(assumed.left, assumed.phantom),
        RefractedCamera(assumed.right, assumed.phantom),
    )
    return np.stack([midpoint(views, pair) for pair in zip(left, right, strict=True)])


def tip_error_p95(calibration: StereoCalibration, covariance: Array) -> float:
    """Return the 95 % error of tips that a calibration's uncertainty causes [m].

    Parameters
    ----------
    calibration : StereoCalibration
        The calibration.
    covariance : ndarray, shape (32, 32)
        Of the parameters that all views share (`rig_model.shared_names`).
    """
    generator = np.random.default_rng(_SEED)
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    draws = generator.standard_normal((_DRAWS, SHARED_PARAMETERS)) @ root.T
    shifts = np.einsum("nij,dj->dni", _tip_slopes(calibration), draws)
    return float(np.percentile(np.linalg.norm(shifts, axis=-1), 95.0))


def _tip_slopes(calibration: StereoCalibration) -> Array:
    """Return d(tip)/d(shared parameters), shape (points, 3, 32).

    The pixels stay: J_tip d(tip) + J_parameters d(parameters) = 0, in the least squares sense.
    """
    points = phantom_points(calibration.phantom.surface_height)
    nowhere = Corners(points, np.zeros((len(points), 2)))
    view = BoardView("", Place(np.eye(4), under_surface=True), nowhere, nowhere)
    model = RigModel(calibration, [view], np.eye(4)[None])
    free = np.zeros(len(model.start), dtype=bool)
    free[:SHARED_PARAMETERS] = True
    # Residuals are seen minus expected: the sign turns twice.
    by_parameter = model.jacobian(model.start, free).reshape(2, len(points), 2, -1)
    cameras = [RefractedCamera(getattr(calibration, side), calibration.phantom) for side in SIDES]
    slopes = []
    for i, point in enumerate(points):
        by_tip = np.concatenate([camera.jacobian(point) for camera in cameras])
        slopes.append(np.linalg.pinv(by_tip) @ by_parameter[:, i].reshape(4, -1))
    return np.stack(slopes)
