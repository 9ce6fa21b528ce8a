"""Stereo images of a needle in a clear phantom, as the cameras above its surface see it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

from needle_sim.needle_shape import NeedleShape
from needle_sim.projection import camera_centre, project
from needle_sim.se3 import FloatArray
from needle_sim.stereo_rig import Camera, StereoRig
from needle_sim.stroke import stroke

GreyImage = NDArray[np.uint8]
_FloatImage = NDArray[np.float32]

# Grey levels under full light.
_PHANTOM = 188.0
_BENCH = 150.0
_NEEDLE = 46.0
_SHEATH = 92.0
_ENTRY_RIM = 34.0
# Lens and pixel: an edge rises over about 2 px, as with a well focused 16 mm lens.
_BLUR_PX = 0.7
_NOISE = 3.0
# The sensor's noise at 65536 equally likely levels: one 16-bit draw a pixel takes a third of the
# time of a normal one.
_NOISE_TABLE = (_NOISE * ndtri((np.arange(65536) + 0.5) / 65536.0)).astype(np.float32)
_NOISE_BAND_ROWS = 32
_MOTTLE = 1.5
_MOTTLE_SIZE_PX = 15.0
_LINE_SPACING = 0.0003

_SHEATH_LENGTH = 0.04
_SHEATH_DIAMETER = 0.003
_RIM_LENGTH = 0.0044
_RIM_DIAMETER = 0.0012


class StereoRenderer:
    """Draws the needle as both cameras see it, refracted by the phantom's surface.

    Seen are the shaft inside the phantom, dark on bright plastisol in uneven light, the entry
    hole's rim at rig's origin and the support sheath before it, which hides the shaft outside.
    Refraction is that of an endless surface: what little is seen before the phantom's front face is
    drawn as if it were inside. Two renderers of one rig and seed draw the same images, bit for
    bit: the sensor's noise depends on seed, exposure number and camera alone.

    Parameters
    ----------
    rig : StereoRig
        Cameras and phantom.
    seed : int
        Not negative.
    needle : NeedleShape
        What is drawn along the tip's path.
    """

    def __init__(self, rig: StereoRig, seed: int, needle: NeedleShape | None = None) -> None:
        self._seed = seed
        self._needle = NeedleShape() if needle is None else needle
        self._views = tuple(
            _View(rig, camera, np.random.default_rng([seed, 0, stream]))
            for stream, camera in ((2, rig.left), (3, rig.right))
        )

    def render(
        self,
        T_rig_tip: ArrayLike,  # noqa: N803
        centreline: ArrayLike,
        exposure_number: int,
    ) -> tuple[GreyImage, GreyImage]:
        """Return the images of one exposure.

        Parameters
        ----------
        T_rig_tip : array_like, shape (4, 4)
            Pose of the tip in `rig` [m].
        centreline : array_like, shape (N, 3)
            Path of the tip from the entry point, at distances of 1 mm or less, the tip last [m];
            a single point draws no needle.
        exposure_number : int
            Keys the sensor's noise; not negative.

        Returns
        -------
        left, right : ndarray of uint8, shape (image_height, image_width)
            Grey images.
        """
        line = self._needle.middle_line(
            np.asarray(T_rig_tip, dtype=np.float64),
            np.asarray(centreline, dtype=np.float64),
            _LINE_SPACING,
        )
        left, right = (
            view.exposure(
                line,
                self._needle.diameter,
                np.random.default_rng([self._seed, exposure_number, stream]),
            )
            for stream, view in enumerate(self._views)
        )
        return left, right


class _View:
    """One camera's light, what never moves in its image, and the needle drawn over it."""

    def __init__(self, rig: StereoRig, camera: Camera, rng: np.random.Generator) -> None:
        self._rig = rig
        self._camera = camera
        self._light = _uneven_light(camera)
        self._background = self._still_scene(rng)

    def exposure(self, line: FloatArray, diameter: float, rng: np.random.Generator) -> GreyImage:
        image = self._background.copy()
        if len(line):
            self._draw_tube(image, line, diameter, _NEEDLE)
        # In bands that stay in the cache: large temporaries cost more than the noise itself.
        for top in range(0, len(image), _NOISE_BAND_ROWS):
            band = image[top : top + _NOISE_BAND_ROWS]
            band += _NOISE_TABLE.take(rng.integers(0, 65536, band.shape, dtype=np.uint16))
        # Rounds and saturates.
        return np.asarray(cv2.convertScaleAbs(cv2.max(image, 0.0)), dtype=np.uint8)

    def _project(self, points: FloatArray) -> FloatArray:
        return project(points, self._camera, self._rig.surface_height, self._rig.refractive_index)

    def _still_scene(self, rng: np.random.Generator) -> _FloatImage:
        image = np.full(self._light.shape, _PHANTOM, dtype=np.float32)
        mottle = cv2.GaussianBlur(
            rng.standard_normal(image.shape, dtype=np.float32), (0, 0), _MOTTLE_SIZE_PX
        )
        image += _MOTTLE * mottle / mottle.std()
        # The bench before the phantom's front face, up to the upper edge of that face.
        edge = np.array([[self._rig.surface_height, y, 0.0] for y in (-0.1, 0.1)])
        beside = edge - [0.0, 0.0, 0.1]
        outline = np.rint(self._project(np.concatenate([edge, beside[::-1]]))).astype(np.int32)
        bench = cv2.fillPoly(np.zeros_like(image), [outline], 1.0)
        image += (_BENCH - _PHANTOM) * cv2.GaussianBlur(bench, (0, 0), 1.5)
        image *= self._light
        rim = np.zeros((12, 3))
        rim[:, 1] = np.linspace(-_RIM_LENGTH / 2.0, _RIM_LENGTH / 2.0, 12)
        sheath = np.zeros((120, 3))
        sheath[:, 2] = np.linspace(-_SHEATH_LENGTH, 0.0, 120)
        self._draw_tube(image, sheath, _SHEATH_DIAMETER, _SHEATH)
        self._draw_tube(image, rim, _RIM_DIAMETER, _ENTRY_RIM)
        return image

    def _draw_tube(
        self, image: _FloatImage, line: FloatArray, diameter: float, grey: float
    ) -> None:
        """Draw a metal tube: dark at its edges, a soft reflection of the light along its middle."""
        to_camera = camera_centre(self._camera) - line
        sideways = np.cross(np.gradient(line, axis=0), to_camera)
        sideways *= diameter / 2.0 / np.linalg.norm(sideways, axis=1)[:, np.newaxis]
        middle, edge, other_edge = self._project(np.stack([line, line + sideways, line - sideways]))
        half_width = np.linalg.norm(edge - other_edge, axis=1) / 2.0
        height, width = image.shape
        tube = stroke(middle, half_width, _BLUR_PX, (width, height))
        pixels = (tube.row, tube.column)
        metal = grey * (0.8 + 0.6 * np.exp(-((tube.across / 0.5) ** 2)))
        image[pixels] += tube.coverage * (metal * self._light[pixels] - image[pixels])


def _uneven_light(camera: Camera) -> _FloatImage:
    """Return the light over the image: a lamp to one side, and the lens's fall-off."""
    u = np.linspace(-1.0, 1.0, camera.image_width, dtype=np.float32)
    v = np.linspace(-1.0, 1.0, camera.image_height, dtype=np.float32)[:, np.newaxis]
    return np.asarray(1.0 + 0.09 * u - 0.06 * v - 0.05 * (u * u + v * v), dtype=np.float32)
