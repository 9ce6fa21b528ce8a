"""One camera over the phantom: where it sees points, how large and how sharp."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from needle_sim.camera.projection import camera_centre, project
from needle_sim.camera.scenarios import Lens
from needle_sim.camera.stereo_rig import Camera, StereoRig
from needle_sim.needle.se3 import FloatArray

FloatImage = NDArray[np.float32]

# Lens and pixel: an edge rises over about 2 px, as with a well focused 16 mm lens.
SHARP_PX = 0.7


class Optics:
    """A camera, the surface it looks through and its lens.

    Parameters
    ----------
    rig : StereoRig
        The phantom.
    camera : Camera
        One of its cameras.
    lens : Lens or None
        None is in focus everywhere.
    """

    def __init__(self, rig: StereoRig, camera: Camera, lens: Lens | None) -> None:
        self.camera = camera
        self.surface_height = rig.surface_height
        self.centre = camera_centre(camera)
        self._refractive_index = rig.refractive_index
        self._lens = lens

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.camera.image_width, self.camera.image_height

    def project(self, points: FloatArray) -> FloatArray:
        """Return the pixels (..., 2) of points (..., 3) in `rig` [m]."""
        return project(points, self.camera, self.surface_height, self._refractive_index)

    def sideways(self, line: FloatArray, half_width: float) -> FloatArray:
        """Return the way from a line's points to its edge as this camera sees it, (M, 3) [m]."""
        sideways = np.cross(np.gradient(line, axis=0), self.centre - line)
        sideways *= half_width / np.linalg.norm(sideways, axis=1)[:, np.newaxis]
        return sideways

    def radius_px(self, points: FloatArray, radius: FloatArray | float) -> FloatArray:
        """Return the radius in the image, (N,), of spheres about points, (N, 3) [px]."""
        aside = np.zeros_like(points)
        aside[:, 2] = radius
        ends = self.project(np.stack([points + aside, points - aside]))
        return np.asarray(np.linalg.norm(ends[0] - ends[1], axis=-1) / 2.0)

    def blur_px(self, points: FloatArray) -> float | FloatArray:
        """Return the blur's standard deviation at points (..., 3): one for all if in focus [px].

        A disk of confusion of diameter c blurs like a Gaussian of c / 4. Refraction lifts what is
        in the phantom: its distance counts 1 / n.
        """
        if self._lens is None:
            return SHARP_PX
        sharp, seen = (
            self.centre[0] - self._apparent_height(np.asarray(height))
            for height in (self._lens.focus_height, points[..., 0])
        )
        focal_px = float(self.camera.camera_matrix[0, 0])
        confusion = self._lens.aperture * focal_px * np.abs(seen - sharp) / (seen * sharp)
        return np.asarray(np.hypot(SHARP_PX, confusion / 4.0))

    def _apparent_height(self, height: FloatArray) -> FloatArray:
        below = np.maximum(self.surface_height - height, 0.0)
        return np.asarray(height + below * (1.0 - 1.0 / self._refractive_index))
