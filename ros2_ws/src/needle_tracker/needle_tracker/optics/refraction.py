"""A camera that looks through the phantom's flat surface: Snell's law, both ways.

The surface is the plane x = surface_height of `rig`; the camera is above it in air, the phantom
below. A ray from the camera and its continuation in the phantom lie in one vertical plane, so that
both directions reduce to that plane.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from needle_tracker.optics.calibration import Camera, Phantom
from needle_tracker.optics.camera_model import optical_rays, project_optical
from needle_tracker.optics.compiled_projection import pack_camera

Array = NDArray[np.float64]

_ROOT_ITERATIONS = 60
_LEAST_DEPTH = 1e-12  # [m]: keeps Snell's law regular for points that are not below the surface
_JACOBIAN_STEP = 1e-5  # [m]: central differences are then good to about 1e-8 relative


class RefractedCamera:
    """Projection between points of the phantom and pixels of one camera.

    Parameters
    ----------
    camera : Camera
        Calibrated camera, above the surface.
    phantom : Phantom
        Surface height and refractive index.
    """

    def __init__(self, camera: Camera, phantom: Phantom) -> None:
        self.camera = camera
        self.phantom = phantom
        self._centre = camera.centre
        self._rotation = camera.T_optical_rig[:3, :3]
        self._translation = camera.T_optical_rig[:3, 3]
        self._camera_height = float(self._centre[0]) - phantom.surface_height
        self.packed = pack_camera(camera, phantom)

    def rays(self, pixels: Array) -> tuple[Array, Array]:
        """Return the refracted rays, in the phantom, that pixels look along.

        Parameters
        ----------
        pixels : ndarray, shape (..., 2)
            Pixel coordinates.

        Returns
        -------
        origins : ndarray, shape (..., 3)
            Where the rays enter the phantom: points of the surface in `rig` [m].
        directions : ndarray, shape (..., 3)
            Unit directions in `rig`, downwards (x < 0). NaN for a pixel that does not look down.
        """
        air = optical_rays(self.camera, np.asarray(pixels, dtype=np.float64)) @ self._rotation
        down = np.where(air[..., 0] < 0.0, -air[..., 0], np.nan)
        origins = self._centre + air * (self._camera_height / down)[..., None]
        origins[..., 0] = self.phantom.surface_height
        # Snell: the part along the surface shrinks by the index; unit length gives the rest.
        directions = air / self.phantom.refractive_index
        along2 = directions[..., 1] ** 2 + directions[..., 2] ** 2
        directions[..., 0] = -np.sqrt(1.0 - along2) * np.where(np.isnan(down), np.nan, 1.0)
        return origins, directions

    def project(self, points: Array) -> Array:
        """Return the pixels at which points are seen.

        Parameters
        ----------
        points : ndarray, shape (..., 3)
            Points in `rig` [m]; above the surface they are seen straight.

        Returns
        -------
        ndarray, shape (..., 2)
            Pixel coordinates, also outside the image; NaN behind the camera.
        """
        points = np.asarray(points, dtype=np.float64)
        offset = points - self._centre
        distance = np.hypot(offset[..., 1], offset[..., 2])
        depth = self.phantom.surface_height - points[..., 0]
        crossing = self._crossing(distance, np.maximum(depth, _LEAST_DEPTH))
        ratio = np.divide(crossing, distance, out=np.ones_like(distance), where=distance > 0.0)
        # The point of the surface through which the camera sees the point.
        target = self._centre + offset * ratio[..., None]
        target[..., 0] = self.phantom.surface_height
        target = np.where((depth > 0.0)[..., None], target, points)
        return project_optical(self.camera, target @ self._rotation.T + self._translation)

    def jacobian(self, point: Array) -> Array:
        """Return d(pixel)/d(point) [px/m], shape (2, 3), at one point in `rig` [m]."""
        steps = _JACOBIAN_STEP * np.concatenate([np.eye(3), -np.eye(3)])
        pixels = self.project(point + steps)
        return np.asarray((pixels[:3] - pixels[3:]).T / (2.0 * _JACOBIAN_STEP))

    def _crossing(self, distance: Array, depth: Array) -> Array:
        """Return how far from the camera's foot, along the surface, the light path crosses it.

        Snell's law in the vertical plane, rho the wanted distance:
        rho / sqrt(rho^2 + h^2) = n (D - rho) / sqrt((D - rho)^2 + d^2).
        The difference of the sides increases with rho and has one root in [0, D].
        """
        index, height = self.phantom.refractive_index, self._camera_height
        low, high = np.zeros_like(distance), np.array(distance)
        rho = distance * index * height / (index * height + depth)
        for _ in range(_ROOT_ITERATIONS):
            rest = distance - rho
            air, body = np.hypot(rho, height), np.hypot(rest, depth)
            value = rho / air - index * rest / body
            slope = height**2 / air**3 + index * depth**2 / body**3
            low = np.where(value < 0.0, rho, low)
            high = np.where(value > 0.0, rho, high)
            newton = rho - value / slope
            inside = (newton >= low) & (newton <= high)
            following = np.where(inside, newton, 0.5 * (low + high))
            change = np.abs(following - rho)
            rho = following
            if not np.any(change > 1e-15 * distance):
                break
        return rho
