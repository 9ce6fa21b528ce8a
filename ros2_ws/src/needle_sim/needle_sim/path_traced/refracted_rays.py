"""Rays from a camera's pixels into the phantom: Snell's law at its window's faces, exactly."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from needle_sim.camera.stereo_rig import SimulatedCamera, StereoRig
from needle_sim.needle.se3 import FloatArray
from needle_sim.path_traced.block import LENGTH, is_box, reach_sideways

# Each iteration leaves less than a hundredth of the lens distortion's error.
_UNDISTORTING_STEPS = 14


@dataclasses.dataclass(frozen=True, eq=False)
class Rays:
    """Rays that start where lines of sight enter the phantom, or pass it by.

    Attributes
    ----------
    origin : ndarray, shape (..., 3)
        On the window's inner face, in `rig`; of lines of sight that pass it by, on the outer [m].
    direction : ndarray, shape (..., 3)
        Of unit length, in `rig`, behind that face.
    in_air : ndarray of bool, shape (...)
        Whether a line of sight passes the phantom by: nothing bends it.
    """

    origin: FloatArray
    direction: FloatArray
    in_air: NDArray[np.bool_]


def refracted_rays(pixels: ArrayLike, camera: SimulatedCamera, rig: StereoRig) -> Rays:
    """Return the lines of sight of pixels.

    The phantom begins at z = 0, where the needle enters. A surface that both cameras share has no
    other end; a box's wall ends at the box's other walls.

    Parameters
    ----------
    pixels : array_like, shape (..., 2)
        u, v [px]; whole numbers are pixel centres.
    camera : SimulatedCamera
        One of the rig's.
    rig : StereoRig
        The phantom.

    Returns
    -------
    Rays
        One for each pixel.
    """
    pixels = np.asarray(pixels, dtype=np.float64)
    pose, window = camera.T_optical_rig, camera.window
    seen = np.ones((*pixels.shape[:-1], 3))
    seen[..., :2] = _undistorted(pixels, camera)
    incoming = seen @ pose[:3, :3]
    incoming /= np.linalg.norm(incoming, axis=-1, keepdims=True)

    inwards = incoming @ window.normal
    length = (window.outer - window.height(camera.centre)) / inwards
    outer = camera.centre + length[..., np.newaxis] * incoming
    # Snell: what lies in the faces shrinks by n, the rest of the unit length leads inwards.
    flat = incoming - inwards[..., np.newaxis] * window.normal
    origin = outer
    for thickness, index in zip(window.thicknesses, window.indices, strict=False):
        direction = _bent(flat / index, window.normal)
        origin = origin - thickness / (direction @ window.normal)[..., np.newaxis] * direction
    direction = _bent(flat / window.indices[-1], window.normal)

    in_air = origin[..., 2] <= 0.0
    if is_box(rig):
        beside = np.abs(origin @ window.sideways) >= reach_sideways(camera, rig)
        in_air |= (origin[..., 2] >= LENGTH) | beside
    straight = in_air[..., np.newaxis]
    return Rays(np.where(straight, outer, origin), np.where(straight, incoming, direction), in_air)


def _bent(flat: FloatArray, normal: FloatArray) -> FloatArray:
    """Return unit vectors against a normal with a part (..., 3) across it."""
    return np.asarray(flat - np.sqrt(1.0 - (flat**2).sum(axis=-1))[..., np.newaxis] * normal)


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
