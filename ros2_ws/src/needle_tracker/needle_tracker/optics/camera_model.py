"""Pinhole camera with plumb_bob distortion, for points (whole images are never undistorted)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from needle_tracker.optics.calibration import Camera

Array = NDArray[np.float64]


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
