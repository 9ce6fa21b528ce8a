"""Rays from a camera's pixels into the phantom: Snell's law at its flat top, exactly."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike

from needle_sim.camera.stereo_rig import SimulatedCamera, StereoRig
from needle_sim.needle.se3 import FloatArray
from needle_sim.path_traced.level_surface import refractive_index

# Each iteration leaves less than a hundredth of the lens distortion's error.
_UNDISTORTING_STEPS = 7


@dataclasses.dataclass(frozen=True, eq=False)
class Rays:
    """Rays that start on the plane of the phantom's top.

    Attributes
    ----------
    origin : ndarray, shape (..., 3)
        Where the line of sight crosses that plane, in `rig` [m].
    direction : ndarray, shape (..., 3)
        Of unit length, in `rig`, below that plane.
    incoming : ndarray, shape (..., 3)
        Of unit length, in `rig`, above that plane: from the camera down.
    """

    origin: FloatArray
    direction: FloatArray
    incoming: FloatArray


def refracted_rays(pixels: ArrayLike, camera: SimulatedCamera, rig: StereoRig) -> Rays:
    """Return the lines of sight of pixels.

    The phantom begins at z = 0, where the needle enters. Before its front face there is air, and
    the lines of sight go straight on.

    Parameters
    ----------
    pixels : array_like, shape (..., 2)
        u, v [px]; whole numbers are pixel centres.
    camera : SimulatedCamera
        The calibrated camera.
    rig : StereoRig
        The phantom.

    Returns
    -------
    Rays
        One for each pixel.
    """
    pixels = np.asarray(pixels, dtype=np.float64)
    pose = camera.T_optical_rig
    seen = np.ones((*pixels.shape[:-1], 3))
    seen[..., :2] = _undistorted(pixels, camera)
    incoming = seen @ pose[:3, :3]
    incoming /= np.linalg.norm(incoming, axis=-1, keepdims=True)

    centre = camera.centre
    length = (rig.half_height - centre[0]) / incoming[..., 0]
    origin = centre + length[..., np.newaxis] * incoming

    # Snell: what lies in the surface shrinks by n, the rest of the unit length is downwards.
    direction = incoming / refractive_index(rig)
    direction[..., 0] = -np.sqrt(1.0 - (direction[..., 1:] ** 2).sum(axis=-1))
    in_air = origin[..., 2] <= 0.0
    direction[in_air] = incoming[in_air]
    return Rays(origin, direction, incoming)


def points_at_height(rays: Rays, height: float) -> FloatArray:
    """Return where rays reach the plane x = `height` [m] below the surface, (..., 3) [m]."""
    length = (height - rays.origin[..., 0]) / rays.direction[..., 0]
    return np.asarray(rays.origin + length[..., np.newaxis] * rays.direction)


def _undistorted(pixels: FloatArray, camera: SimulatedCamera) -> FloatArray:
    """Return normalised image coordinates: the inverse of plumb_bob by fixed-point iteration."""
    k1, k2, p1, p2, k3 = camera.distortion
    inverse = np.linalg.inv(camera.camera_matrix[:2, :2])
    distorted = (pixels - camera.camera_matrix[:2, 2]) @ inverse.T
    ideal = distorted
    for _ in range(_UNDISTORTING_STEPS):
        x, y = ideal[..., 0], ideal[..., 1]
        square = x * x + y * y
        radial = 1.0 + square * (k1 + square * (k2 + square * k3))
        shift_x = 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
        shift_y = p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y
        shift = np.stack([shift_x, shift_y], axis=-1)
        ideal = (distorted - shift) / radial[..., np.newaxis]
    return np.asarray(ideal)
