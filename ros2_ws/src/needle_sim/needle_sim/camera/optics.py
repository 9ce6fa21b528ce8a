"""Optics of a camera in front of the phantom: refraction, projection, size and blur of points."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from needle_sim.camera.scenarios import Lens
from needle_sim.camera.stereo_rig import SimulatedCamera, SimulatedWindow
from needle_sim.needle.se3 import FloatArray

# The equation for the slope is concave and increasing: Newton's method converges in 3 steps.
_NEWTON_STEPS = 4


def refraction_point(points: ArrayLike, centre: ArrayLike, window: SimulatedWindow) -> FloatArray:
    """Return where the ray from a point to a camera crosses the window's outer face.

    With a = tan(angle in air), Snell's law gives tan(angle in a medium) = a / sqrt(n^2 + (n^2 - 1)
    a^2); the offsets in air and all media must add up to the distance along the window.

    Parameters
    ----------
    points : array_like, shape (..., 3)
        Points in `rig`, below the camera [m]. Above the face the ray is straight, and its extension
        crosses the face.
    centre : array_like, shape (3,)
        Centre of projection in `rig`, above the face [m].
    window : SimulatedWindow
        Window of the camera.

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
    lengths = window.layer_lengths(level)
    # A point above the face shortens the path in air.
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
    """Return the pixels of points that a camera sees through its window.

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
    in_camera = crossing @ pose[:3, :3].T + pose[:3, 3]
    return _distorted_pixel(
        in_camera[..., 0] / in_camera[..., 2], in_camera[..., 1] / in_camera[..., 2], camera
    )


def _distorted_pixel(x: FloatArray, y: FloatArray, camera: SimulatedCamera) -> FloatArray:
    """Apply plumb_bob and the camera matrix to normalized image coordinates."""
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


FloatImage = NDArray[np.float32]

# Blur of lens and pixel: an edge rises over about 2 px, as with a well focused 16 mm lens.
SHARP_PX = 0.7


class Optics:
    """Camera with its window and its lens.

    Parameters
    ----------
    camera : SimulatedCamera
        Camera of the rig.
    lens : Lens or None
        Lens; None: in focus everywhere.
    """

    def __init__(self, camera: SimulatedCamera, lens: Lens | None) -> None:
        self.camera = camera
        self.window = camera.window
        self.centre = camera.centre
        self._lens = lens

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.camera.image_width, self.camera.image_height

    def project(self, points: FloatArray) -> FloatArray:
        """Return the pixels (..., 2) of points (..., 3) in `rig` [m]."""
        return project(points, self.camera)

    def in_image(self, pixels: FloatArray) -> NDArray[np.bool_]:
        """Return whether pixels, (N, 2), are inside the image."""
        inside = (pixels >= 0.0) & (pixels <= np.subtract(self.image_size, 1.0))
        return np.asarray(inside.all(axis=1))

    def points_on_face(self, aside: FloatArray, along: FloatArray) -> FloatArray:
        """Return points (N, 3) of the window's outer face in `rig` [m].

        Parameters
        ----------
        aside, along : ndarray, shape (N,)
            Offset from the needle's axis across the view of this camera, and along the axis [m].
        """
        points = aside[:, np.newaxis] * self.window.sideways
        points[:, 2] += along
        off = self.window.outer - self.window.height(points)
        return np.asarray(points + off[:, np.newaxis] * self.window.normal)

    def lateral_vectors(self, line: FloatArray, half_width: float) -> FloatArray:
        """Return vectors from a line's points to its edge in this camera's view, (M, 3) [m]."""
        sideways = np.cross(np.gradient(line, axis=0), self.centre - line)
        sideways *= half_width / np.linalg.norm(sideways, axis=1)[:, np.newaxis]
        return sideways

    def radius_px(self, points: FloatArray, radius: FloatArray | float) -> FloatArray:
        """Return the radii in the image, (N,), of spheres around points, (N, 3) [px]."""
        aside = np.zeros_like(points)
        aside[:, 2] = radius
        ends = self.project(np.stack([points + aside, points - aside]))
        return np.asarray(np.linalg.norm(ends[0] - ends[1], axis=-1) / 2.0)

    def blur_px(self, points: FloatArray) -> float | FloatArray:
        """Return the blur's standard deviation at points (..., 3), a scalar without a lens [px].

        A circle of confusion of diameter c blurs like a Gaussian of standard deviation c / 4.
        Refraction scales the apparent depth in a medium by 1 / n.
        """
        if self._lens is None:
            return SHARP_PX
        focus, distance = (
            self.window.height(self.centre) - self._apparent_height(np.asarray(height))
            for height in (self._lens.focus_height, self.window.height(points))
        )
        focal_px = float(self.camera.camera_matrix[0, 0])
        confusion = self._lens.aperture * focal_px * np.abs(distance - focus) / (distance * focus)
        return np.asarray(np.hypot(SHARP_PX, confusion / 4.0))

    def _apparent_height(self, height: FloatArray) -> FloatArray:
        lengths = self.window.layer_lengths(height)
        for length, index in zip(lengths, self.window.indices, strict=True):
            height = height + length * (1.0 - 1.0 / index)
        return height
