"""Projection of points inside the phantom to a camera in air: Snell's law at its flat top."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from needle_sim.camera.stereo_rig import Camera
from needle_sim.needle.se3 import FloatArray

# The slope's equation is concave and increasing: Newton is at the last digit after 3 steps.
_NEWTON_STEPS = 4


def camera_centre(camera: Camera) -> FloatArray:
    """Return the centre of projection in `rig`, shape (3,) [m]."""
    pose = camera.T_optical_rig
    return np.asarray(-pose[:3, :3].T @ pose[:3, 3])


def refraction_point(
    points: ArrayLike, centre: ArrayLike, surface_height: float, refractive_index: float
) -> FloatArray:
    """Return where the ray from a point to a camera crosses the surface x = surface_height.

    With a = tan(angle in air), Snell's law makes tan(angle in the phantom)
    a / sqrt(n^2 + (n^2 - 1) a^2); the two stretches must add up to the horizontal distance.

    Parameters
    ----------
    points : array_like, shape (..., 3)
        Points in `rig`, below the camera [m]. Above the surface the ray is straight, and the
        crossing is that of its extension.
    centre : array_like, shape (3,)
        Centre of projection in `rig`, above the surface [m].
    surface_height : float
        x of the surface in `rig` [m].
    refractive_index : float
        Of the phantom, against air.

    Returns
    -------
    ndarray, shape (..., 3)
        Points of the surface in `rig` [m].
    """
    points = np.asarray(points, dtype=np.float64)
    centre = np.asarray(centre, dtype=np.float64)
    depth = surface_height - points[..., 0]
    height = centre[0] - surface_height
    index = np.where(depth > 0.0, refractive_index, 1.0)
    horizontal = points[..., 1:] - centre[1:]
    distance = np.linalg.norm(horizontal, axis=-1)

    slope = distance / (height + depth / index)
    for _ in range(_NEWTON_STEPS):
        square = index**2 + (index**2 - 1.0) * slope**2
        root = np.sqrt(square)
        error = height * slope + depth * slope / root - distance
        slope = slope - error / (height + depth * index**2 / (square * root))

    share = height * slope / np.where(distance > 0.0, distance, 1.0)
    crossing = np.empty(points.shape)
    crossing[..., 0] = surface_height
    crossing[..., 1:] = centre[1:] + share[..., np.newaxis] * horizontal
    return crossing


def project(
    points: ArrayLike, camera: Camera, surface_height: float, refractive_index: float
) -> FloatArray:
    """Return the pixels at which a camera sees points through the phantom's surface.

    Parameters
    ----------
    points : array_like, shape (..., 3)
        Points in `rig` [m].
    camera : Camera
        The calibrated camera.
    surface_height : float
        x of the surface in `rig` [m].
    refractive_index : float
        Of the phantom, against air.

    Returns
    -------
    ndarray, shape (..., 2)
        u, v [px]; whole numbers are pixel centres.
    """
    crossing = refraction_point(points, camera_centre(camera), surface_height, refractive_index)
    pose = camera.T_optical_rig
    seen = crossing @ pose[:3, :3].T + pose[:3, 3]
    return _distorted_pixel(seen[..., 0] / seen[..., 2], seen[..., 1] / seen[..., 2], camera)


def _distorted_pixel(x: FloatArray, y: FloatArray, camera: Camera) -> FloatArray:
    """Apply plumb_bob and the camera matrix to normalised image coordinates."""
    k1, k2, p1, p2, k3 = camera.distortion
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    distorted = np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
            y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )
    return np.asarray(distorted @ camera.camera_matrix[:2, :2].T + camera.camera_matrix[:2, 2])
