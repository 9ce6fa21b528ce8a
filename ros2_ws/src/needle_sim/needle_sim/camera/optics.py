"""One camera before the phantom: where it sees points, how large and how sharp."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from needle_sim.camera.projection import project
from needle_sim.camera.scenarios import Lens
from needle_sim.camera.stereo_rig import SimulatedCamera
from needle_sim.needle.se3 import FloatArray

FloatImage = NDArray[np.float32]

# Lens and pixel: an edge rises over about 2 px, as with a well focused 16 mm lens.
SHARP_PX = 0.7


class Optics:
    """A camera, the window it looks through and its lens.

    Parameters
    ----------
    camera : SimulatedCamera
        One of the rig's.
    lens : Lens or None
        None is in focus everywhere.
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

    def on_face(self, aside: FloatArray, along: FloatArray) -> FloatArray:
        """Return points (N, 3) of the window's outer face in `rig` [m].

        Parameters
        ----------
        aside, along : ndarray, shape (N,)
            How far they are beside the needle's axis, as this camera sees it, and along it [m].
        """
        points = aside[:, np.newaxis] * self.window.sideways
        points[:, 2] += along
        off = self.window.outer - self.window.height(points)
        return np.asarray(points + off[:, np.newaxis] * self.window.normal)

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
        in a layer or the phantom: its distance counts 1 / n.
        """
        if self._lens is None:
            return SHARP_PX
        sharp, seen = (
            self.window.height(self.centre) - self._apparent_height(np.asarray(height))
            for height in (self._lens.focus_height, self.window.height(points))
        )
        focal_px = float(self.camera.camera_matrix[0, 0])
        confusion = self._lens.aperture * focal_px * np.abs(seen - sharp) / (seen * sharp)
        return np.asarray(np.hypot(SHARP_PX, confusion / 4.0))

    def _apparent_height(self, height: FloatArray) -> FloatArray:
        lengths = self.window.passed(height)
        for length, index in zip(lengths, self.window.indices, strict=True):
            height = height + length * (1.0 - 1.0 / index)
        return height
