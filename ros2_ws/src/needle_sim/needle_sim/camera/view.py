"""Image of one camera: a static background, and the moving objects of each exposure."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from needle_sim.camera.clutter import (
    CABLE_DIAMETER,
    PAPER_GREY,
    PAPER_LINE_WIDTH,
    BubbleCloud,
    BubbleImage,
    draw_bubbles,
)
from needle_sim.camera.lighting import (
    drift,
    flicker,
    lamp_light,
    lamp_reflection,
    shaft_glints,
    surface_glints,
    uneven_light,
)
from needle_sim.camera.optics import SHARP_PX, FloatImage, Optics
from needle_sim.camera.scenarios import MetalShaft, Scenario
from needle_sim.camera.stroke import Stroke, stroke
from needle_sim.needle.se3 import FloatArray

GreyImage = NDArray[np.uint8]

# Grey levels under full light.
_PHANTOM = 188.0
_BENCH = 150.0
_NEEDLE = 46.0
_SHEATH = 92.0
_ENTRY_RIM = 34.0
_CABLE = 40.0
_HAND = 118.0
_HAND_EDGE = 62.0
_COVER = 24.0
# Sensor noise at 65536 equally likely levels: drawing a 16-bit number is three times as fast as
# drawing a normal one.
_NORMAL_TABLE = ndtri((np.arange(65536) + 0.5) / 65536.0)
_NOISE_BAND_ROWS = 32
_MOTTLE = 1.5
_MOTTLE_SIZE_PX = 15.0
_BENCH_EDGE_PX = 1.5

_SHEATH_LENGTH = 0.04
_SHEATH_DIAMETER = 0.003
_RIM_LENGTH = 0.0044
_RIM_DIAMETER = 0.0012
# Hands are near the lens and drawn at this coarser resolution.
_HAND_COARSE = 4
_HAND_EDGE_PX = 7.0
_HAND_ROUND_PX = 45.0


@dataclasses.dataclass(frozen=True, eq=False)
class SceneState:
    """Moving objects of an exposure, in `rig`; the same for both cameras.

    Attributes
    ----------
    number : int
        Number of the exposure.
    needle, shadow, cable : ndarray, shape (M, 3)
        Centrelines [m]; empty if absent.
    diameter : float
        Diameter of the needle [m].
    shadow_fall : ndarray, shape (M,)
        Height above the floor of the point that casts each shadow point [m].
    hand : list of (ndarray (3,), ndarray (3,), float)
        Capsules of a hand: end points, radius [m].
    """

    number: int
    needle: FloatArray
    diameter: float
    shadow: FloatArray
    shadow_fall: FloatArray
    cable: FloatArray
    hand: list[tuple[FloatArray, FloatArray, float]]


@dataclasses.dataclass(frozen=True, eq=False)
class StaticScene:
    """Static objects, in `rig`; the same for both cameras.

    Attributes
    ----------
    bubbles : BubbleCloud or None
        Bubbles in the phantom.
    lamp : ndarray, shape (3,)
        Position of the lamp that a metal needle mirrors [m].
    lines : list of ndarray, shape (M, 3)
        Lines of the paper under the phantom [m].
    """

    bubbles: BubbleCloud | None
    lamp: FloatArray
    lines: list[FloatArray]


class View:
    """Renders the images of one camera.

    Parameters
    ----------
    optics : Optics
        Optics of the camera.
    scenario : Scenario
        Disturbances of the images.
    scene : StaticScene
        Static objects.
    mottle_rng : numpy.random.Generator
        Generator of the phantom's mottle.
    light_seed : list of int
        Seed of this camera's light and glints.
    """

    def __init__(
        self,
        optics: Optics,
        scenario: Scenario,
        scene: StaticScene,
        mottle_rng: np.random.Generator,
        light_seed: list[int],
    ) -> None:
        self._optics = optics
        self._scenario = scenario
        self._noise_table = (scenario.noise * _NORMAL_TABLE).astype(np.float32)
        rng = np.random.default_rng(light_seed)
        self._glint_seed = [*light_seed, 1]
        self._phase = float(rng.uniform(0.0, 2.0 * np.pi))
        self._light = lamp_light(optics.camera)
        if scenario.lighting is not None:
            self._light *= uneven_light(scenario.lighting, optics.camera, rng)
        self._bubbles: BubbleImage | None = None
        self._scene = scene
        if scene.bubbles is not None:
            self._bubbles = draw_bubbles(scene.bubbles, optics)
            self._bubbles.added[:] *= self._light
        self._background = self._draw_background(mottle_rng)
        self._glints: FloatImage | None = None
        if scenario.glints is not None:
            self._glints = surface_glints(scenario.glints, optics, rng)

    def exposure(
        self, moment: SceneState, covered: bool, drift_phase: float, rng: np.random.Generator
    ) -> GreyImage:
        """Return the image of one exposure.

        Parameters
        ----------
        moment : SceneState
            Moving objects.
        covered : bool
            Whether the lens is covered.
        drift_phase : float
            Initial phase of the light's drift [rad].
        rng : numpy.random.Generator
            Generator of the sensor noise.
        """
        if covered:
            image = np.asarray(_COVER * self._light, dtype=np.float32)
        else:
            image = self._background.copy()
            self._draw_moment(image, moment)
        lighting = self._scenario.lighting
        if lighting is not None:
            image *= np.float32(drift(lighting, moment.number, drift_phase))
        # In bands that fit into the cache, because large temporaries cost more than the noise.
        for top in range(0, len(image), _NOISE_BAND_ROWS):
            band = image[top : top + _NOISE_BAND_ROWS]
            band += self._noise_table.take(rng.integers(0, 65536, band.shape, dtype=np.uint16))
        # convertScaleAbs rounds and saturates.
        return np.asarray(cv2.convertScaleAbs(cv2.max(image, 0.0)), dtype=np.uint8)

    def visible_share(self, points: FloatArray, moment: SceneState) -> float:
        """Return the share of points (M, 3) in `rig` that are in the image, not behind a hand."""
        pixels = self._optics.project(points)
        visible = self._optics.in_image(pixels)
        if moment.hand and len(points):
            hidden = self._hand_mask(moment)
            column, row = np.rint(pixels[visible]).astype(np.intp).T
            visible[visible] = hidden[row, column] < 0.5
        return float(visible.mean()) if len(points) else 0.0

    def _draw_moment(self, image: FloatImage, moment: SceneState) -> None:
        if len(moment.shadow):
            self._draw_shadow(image, moment)
        if len(moment.needle):
            self._draw_tube(image, moment.needle, moment.diameter, _NEEDLE, is_needle=True)
        glints = self._scenario.glints
        if self._glints is not None and glints is not None:
            factor = flicker(glints, moment.number, self._phase)
            cv2.scaleAdd(self._glints, factor, image, dst=image)
        if len(moment.cable):
            self._draw_tube(image, moment.cable, CABLE_DIAMETER, _CABLE)
        if moment.hand:
            mask = self._hand_mask(moment)
            inner = cv2.GaussianBlur(
                cv2.resize(mask, None, fx=1.0 / _HAND_COARSE, fy=1.0 / _HAND_COARSE),
                (0, 0),
                _HAND_ROUND_PX / _HAND_COARSE,
            )
            skin = cv2.resize(
                _HAND_EDGE + (_HAND - _HAND_EDGE) * inner * inner, self._optics.image_size
            )
            image += mask * (skin * self._light - image)

    def _draw_background(self, rng: np.random.Generator) -> FloatImage:
        image = np.full(self._light.shape, _PHANTOM, dtype=np.float32)
        mottle = cv2.GaussianBlur(
            rng.standard_normal(image.shape, dtype=np.float32), (0, 0), _MOTTLE_SIZE_PX
        )
        image += _MOTTLE * mottle / mottle.std()
        # The bench in front of the phantom, up to the upper edge of its front face.
        edge = self._optics.points_on_face(np.array([-0.1, 0.1]), np.zeros(2))
        beside = edge - [0.0, 0.0, 0.1]
        outline = np.rint(self._optics.project(np.concatenate([edge, beside[::-1]])))
        bench = cv2.fillPoly(np.zeros_like(image), [outline.astype(np.int32)], 1.0)
        softness = float(np.hypot(_BENCH_EDGE_PX, np.max(self._optics.blur_px(edge)) - SHARP_PX))
        image += (_BENCH - _PHANTOM) * cv2.GaussianBlur(bench, (0, 0), softness)
        for line in self._scene.lines:
            self._draw_tube(image, line, PAPER_LINE_WIDTH, PAPER_GREY)
        image *= self._light
        if self._bubbles is not None:
            image *= self._bubbles.gain
            image += self._bubbles.added
        rim = np.zeros((12, 3))
        rim[:, 1] = np.linspace(-_RIM_LENGTH / 2.0, _RIM_LENGTH / 2.0, 12)
        sheath = np.zeros((120, 3))
        sheath[:, 2] = np.linspace(-_SHEATH_LENGTH, 0.0, 120)
        self._draw_tube(image, sheath, _SHEATH_DIAMETER, _SHEATH)
        self._draw_tube(image, rim, _RIM_DIAMETER, _ENTRY_RIM)
        return image

    def _draw_tube(
        self,
        image: FloatImage,
        line: FloatArray,
        diameter: float,
        grey: float,
        is_needle: bool = False,
    ) -> None:
        """Draw a tube in front of the background and behind the bubbles above it."""
        tube = self._stroke(line, diameter, self._optics.blur_px(line))
        pixels = (tube.row, tube.column)
        metal = self._scenario.metal
        if is_needle and metal is not None:
            colour = self._mirroring(line, diameter, tube, metal) * self._light[pixels]
        else:
            # Dark edges, and a soft reflection along the middle.
            colour = grey * (0.8 + 0.6 * np.exp(-((tube.across / 0.5) ** 2)))
            colour *= self._light[pixels]
        if is_needle:
            glints = self._scenario.glints
            if glints is not None:
                bright = shaft_glints(glints, line[:, 2], np.random.default_rng(self._glint_seed))
                colour += bright[tube.sample] * np.exp(-((tube.across / 0.45) ** 2))
            if self._bubbles is not None:
                above = self._bubbles.height[pixels] > self._optics.window.height(line)[tube.sample]
                seen_through = colour * self._bubbles.gain[pixels] + self._bubbles.added[pixels]
                colour = np.where(above, seen_through, colour)
        image[pixels] += tube.coverage * (colour - image[pixels])

    def _mirroring(
        self, line: FloatArray, diameter: float, tube: Stroke, metal: MetalShaft
    ) -> FloatArray:
        """Return the grey levels of a bare metal needle at a stroke's pixels."""
        share, place = lamp_reflection(line, self._optics.centre, self._scene.lamp, metal)
        # The sign across a stroke is defined in the image, that across a shaft in space.
        edge = self._optics.project(line + self._optics.lateral_vectors(line, diameter / 2.0))
        middle = self._optics.project(line)
        ahead, beside = np.gradient(middle, axis=0), edge - middle
        side = np.sign(ahead[:, 0] * beside[:, 1] - ahead[:, 1] * beside[:, 0])
        core = np.exp(-(((tube.across - (side * place)[tube.sample]) / metal.core_width) ** 2))
        return np.asarray(metal.rim + (metal.core - metal.rim) * share[tube.sample] * core)

    def _draw_shadow(self, image: FloatImage, moment: SceneState) -> None:
        shadow = self._scenario.shadow
        assert shadow is not None
        line = moment.shadow
        px_per_m = self._optics.radius_px(line, 1e-3) / 1e-3
        penumbra = shadow.penumbra * moment.shadow_fall * px_per_m
        tube = self._stroke(line, moment.diameter, np.hypot(self._optics.blur_px(line), penumbra))
        pixels = (tube.row, tube.column)
        dark = image[pixels] * (1.0 - shadow.darkness * tube.coverage)
        if self._bubbles is not None:
            # The reflection of a bubble above is not in the shadow.
            added = self._bubbles.added[pixels]
            dark = added + (image[pixels] - added) * (1.0 - shadow.darkness * tube.coverage)
        image[pixels] = dark

    def _stroke(self, line: FloatArray, diameter: float, blur: float | FloatArray) -> Stroke:
        sideways = self._optics.lateral_vectors(line, diameter / 2.0)
        middle, edge, other_edge = self._optics.project(
            np.stack([line, line + sideways, line - sideways])
        )
        half_width = np.linalg.norm(edge - other_edge, axis=1) / 2.0
        return stroke(middle, half_width, blur, self._optics.image_size)

    def _hand_mask(self, moment: SceneState) -> FloatImage:
        """Return the share of each pixel that a hand covers."""
        width, height = self._optics.image_size
        small = np.zeros((-(-height // _HAND_COARSE), -(-width // _HAND_COARSE)), dtype=np.float32)
        for begin, end, radius in moment.hand:
            ends = np.stack([begin, end])
            thickness = 2.0 * self._optics.radius_px(ends, radius).mean() / _HAND_COARSE
            place = np.clip(np.rint(self._optics.project(ends) / _HAND_COARSE), -9999, 9999)
            (u0, v0), (u1, v1) = place.astype(int).tolist()
            cv2.line(small, (u0, v0), (u1, v1), 1.0, max(round(thickness), 1))
        small = cv2.GaussianBlur(small, (0, 0), _HAND_EDGE_PX / _HAND_COARSE)
        mask = cv2.resize(small, (small.shape[1] * _HAND_COARSE, small.shape[0] * _HAND_COARSE))
        return np.asarray(mask[:height, :width], dtype=np.float32)
