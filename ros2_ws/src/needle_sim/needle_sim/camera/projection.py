"""Projection of points inside the phantom to a camera in air: Snell's law at a window's faces."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from needle_sim.camera.stereo_rig import SimulatedCamera
from needle_sim.camera.window import SimulatedWindow
from needle_sim.needle.se3 import FloatArray

# The slope's equation is concave and increasing: Newton is at the last digit after 3 steps.
_NEWTON_STEPS = 4


def refraction_point(points: ArrayLike, centre: ArrayLike, window: SimulatedWindow) -> FloatArray:
    """Return where the ray from a point to a camera crosses the window's outer face.

    With a = tan(angle in air), Snell's law makes tan(angle in a medium) a / sqrt(n^2 + (n^2 - 1)
    a^2); the stretches in air and all media must add up to the distance along the window.

    Parameters
    ----------
    points : array_like, shape (..., 3)
        Points in `rig`, below the camera [m]. Above the face the ray is straight, and the
        crossing is that of its extension.
    centre : array_like, shape (3,)
        Centre of projection in `rig`, above the face [m].
    window : SimulatedWindow
        What the camera looks through.

    Returns
    -------
    ndarray, shape (..., 3)
        Points of the outer face in `rig` [m].
    """
    points = np.asarray(points, dtype=np.float64)
    centre = np.asarray(centre, dtype=np.float64)
    level = window.height(points)
    height = float(window.height(centre)) - window.outer
    foot = centre - window.height(centre) * window.normal
    along = points - level[..., np.newaxis] * window.normal - foot
    distance = np.linalg.norm(along, axis=-1)
    lengths = window.passed(level)
    # What is above the face shortens the way in air.
    straight = height - np.maximum(level - window.outer, 0.0)

    slope = distance / (straight + sum(t / n for t, n in zip(lengths, window.indices, strict=True)))
    for _ in range(_NEWTON_STEPS):
        error, growth = straight * slope - distance, straight
        for length, index in zip(lengths, window.indices, strict=True):
            square = index**2 + (index**2 - 1.0) * slope**2
            root = np.sqrt(square)
            error = error + length * slope / root
            growth = growth + length * index**2 / (square * root)
        slope = slope - error / growth

    share = height * slope / np.where(distance > 0.0, distance, 1.0)
    return np.asarray(foot + window.outer * window.normal + share[..., np.newaxis] * along)


def project(points: ArrayLike, camera: SimulatedCamera) -> FloatArray:
    """Return the pixels at which a camera sees points through its window.

    Parameters
    ----------
    points : array_like, shape (..., 3)
        Points in `rig` [m].
    camera : SimulatedCamera
        The calibrated camera.

    Returns
    -------
    ndarray, shape (..., 2)
        u, v [px]; whole numbers are pixel centres.
    """
    crossing = refraction_point(points, camera.centre, camera.window)
    pose = camera.T_optical_rig
    seen = crossing @ pose[:3, :3].T + pose[:3, 3]
    return _distorted_pixel(seen[..., 0] / seen[..., 2], seen[..., 1] / seen[..., 2], camera)


def _distorted_pixel(x: FloatArray, y: FloatArray, camera: SimulatedCamera) -> FloatArray:
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
