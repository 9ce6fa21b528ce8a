"""Pinhole camera with plumb_bob distortion, for points (whole images are never undistorted)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from needle_tracker.optics.calibration import Camera

Array = NDArray[np.float64]

_UNDISTORT_ITERATIONS = 12


def distort(points: Array, distortion: Array) -> Array:
    """Apply plumb_bob distortion (Brown's model, as in OpenCV and CameraInfo).

    Parameters
    ----------
    points : ndarray, shape (..., 2)
        Ideal image points at unit focal length [-].
    distortion : ndarray, shape (5,)
        k1, k2, p1, p2, k3.

    Returns
    -------
    ndarray, shape (..., 2)
        Distorted points at unit focal length [-].
    """
    k1, k2, p1, p2, k3 = distortion
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def undistort(points: Array, distortion: Array) -> Array:
    """Invert `distort` by Newton's method, to rounding.

    Parameters
    ----------
    points : ndarray, shape (..., 2)
        Distorted points at unit focal length [-].
    distortion : ndarray, shape (5,)
        k1, k2, p1, p2, k3.

    Returns
    -------
    ndarray, shape (..., 2)
        Ideal points; NaN where the model has no inverse nearby.
    """
    k1, k2, p1, p2, k3 = distortion
    ideal = np.array(points, dtype=np.float64)
    for _ in range(_UNDISTORT_ITERATIONS):
        residual = distort(ideal, distortion) - points
        x, y = ideal[..., 0], ideal[..., 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        j_xx = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        j_yy = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        j_xy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        det = j_xx * j_yy - j_xy * j_xy
        det = np.where(np.abs(det) < 1e-6, np.nan, det)
        step_x = (j_yy * residual[..., 0] - j_xy * residual[..., 1]) / det
        step_y = (j_xx * residual[..., 1] - j_xy * residual[..., 0]) / det
        ideal[..., 0] -= step_x
        ideal[..., 1] -= step_y
        if not np.any(np.abs(step_x) + np.abs(step_y) > 1e-15):
            break
    wrong = np.linalg.norm(distort(ideal, distortion) - points, axis=-1) > 1e-9
    ideal[wrong] = np.nan
    return ideal


def project_optical(camera: Camera, points: Array) -> Array:
    """Project points of the optical frame to pixels.

    Parameters
    ----------
    camera : Camera
        The camera.
    points : ndarray, shape (..., 3)
        In the camera's optical frame [m].

    Returns
    -------
    ndarray, shape (..., 2)
        Pixel coordinates (u right, v down, pixel centres at integers); NaN behind the camera.
    """
    depth = np.where(points[..., 2] > 0.0, points[..., 2], np.nan)
    distorted = distort(points[..., :2] / depth[..., None], camera.distortion)
    matrix = camera.camera_matrix
    return distorted * matrix[[0, 1], [0, 1]] + matrix[:2, 2]


def optical_rays(camera: Camera, pixels: Array) -> Array:
    """Return the unit directions, in the optical frame, that pixels look along.

    Parameters
    ----------
    camera : Camera
        The camera.
    pixels : ndarray, shape (..., 2)
        Pixel coordinates.

    Returns
    -------
    ndarray, shape (..., 3)
        Unit directions in the optical frame; NaN where the distortion has no inverse.
    """
    matrix = camera.camera_matrix
    normalised = (np.asarray(pixels) - matrix[:2, 2]) / matrix[[0, 1], [0, 1]]
    ideal = undistort(normalised, camera.distortion)
    rays = np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=-1)
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))
