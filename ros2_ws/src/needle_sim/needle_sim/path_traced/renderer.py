"""Path-traced stereo images of a metal needle: layers over a floor, then the sensor."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_sim.camera.optics import FloatImage, Optics
from needle_sim.camera.stereo_rig import SimulatedCamera, StereoRig
from needle_sim.camera.view import GreyImage
from needle_sim.needle.se3 import FloatArray
from needle_sim.path_traced.appearance import Appearance
from needle_sim.path_traced.floors import ALBEDO
from needle_sim.path_traced.marks import Marks
from needle_sim.path_traced.needle_mesh import NeedleMesh
from needle_sim.path_traced.path_tracing import PathTracer, refracted_rays
from needle_sim.path_traced.scene import Scene
from needle_sim.path_traced.tracer import Mitsuba
from needle_sim.path_traced.world import PANEL_RADIANCE, Backdrop, make_world

_FULL = 255.0
_HAZE_BLUR_PX = 9.0
_BLOOM_BLUR_PX = 2.5
_BLOOM_ALONG_PX = 14.0
# Beyond this, more light makes no wider bloom: wells overflow into the drain.
_BRIGHTEST = 6.0 * _FULL


def flicker(look: Appearance, number: int) -> float:
    """Return by what the light of an exposure is stronger, for both cameras."""
    rng = np.random.default_rng([look.seed, number, 40])
    return float(np.exp(look.flicker * rng.standard_normal()))


def grey_image(
    light: FloatImage, look: Appearance, black: float, rng: np.random.Generator
) -> GreyImage:
    """Return what the sensor makes of light.

    Parameters
    ----------
    light : ndarray of float32, shape (rows, columns)
        In grey levels, as far above full scale as it is.
    look : Appearance
        Haze, blur, blooming, noise.
    black : float
        What the sensor says of no light [grey levels].
    rng : numpy.random.Generator
        For the noise.
    """
    image = np.minimum(light, _BRIGHTEST).astype(np.float32)
    if look.haze > 0.0:
        # What is scattered forwards arrives beside its place: it takes contrast from what is small.
        glow = cv2.GaussianBlur(image, (0, 0), _HAZE_BLUR_PX)
        image += 0.5 * look.haze * (glow - image)
    image = cv2.GaussianBlur(image, (0, 0), look.blur_px)
    if look.bloom > 0.0:
        beyond = np.maximum(image - _FULL, 0.0)
        around = cv2.GaussianBlur(beyond, (0, 0), _BLOOM_BLUR_PX)
        column = cv2.GaussianBlur(beyond, (1, 0), sigmaX=1e-3, sigmaY=_BLOOM_ALONG_PX)
        image += look.bloom * (6.0 * around + 6.0 * column)
    image += black
    spread = np.sqrt(
        look.noise**2 + look.shot_noise**2 * np.clip(image, 0.0, _FULL) / _FULL, dtype=np.float32
    )
    image += spread * rng.standard_normal(image.shape, dtype=np.float32)
    return np.asarray(np.clip(np.rint(image), 0.0, _FULL), dtype=np.uint8)


_GAIN_STREAM = 33
# Paths a pixel of the needle, of what stands still, and of each place of the floor.
_NEEDLE_SAMPLES = 96
_STILL_SAMPLES = 64
_FLOOR_SAMPLES = 192
_SHADOW_SAMPLES = 48
# What the floor's light is sampled over [m]: across the needle, along it; spacing.
_SIDE = 0.072
_REACH = (-0.03, 0.15)
_SPACING = 0.00075
_GRID_SHAPE = (round(2.0 * _SIDE / _SPACING), round((_REACH[1] - _REACH[0]) / _SPACING))
# How far around what stands before the floor pixels are traced [px].
_MARGIN_PX = 2
_BLACK = (0.0, 8.0)


class PathTracedRenderer:
    """Draws a metal needle as both cameras see it.

    An image is made of layers. The backdrop (the floor, or what stands behind a clear box) is its
    picture times the light on it, which is sampled on a grid, with and without the needle, so that
    the needle's shadow is there. What stands before it (needle, bubbles, walls) is path-traced
    where it is, with its share of each pixel. Lint, old paths and a box's edges are drawn on the
    backdrop's layer. Haze takes from all layers by their distance; then come its glow, blur,
    blooming and noise.

    Exact are shape and place of all that is traced: lines of sight obey Snell's law at each
    camera's window, layer by layer; the phantom begins at z = 0, a box ends at its walls.
    Approximated are: light inside the phantom, which comes straight from lamps that stand where the
    phantom's middle sees them through a level top, also in a box; what the surface mirrors back
    into the phantom, a ring of one brightness, in a box nothing; light that the floor gets from
    walls and needle, none; caustics of bubbles, which only throw shadows; haze, which fades what is
    far by one exponential and glows by one width; the window's own reflections, none; a floor that
    is Lambertian, brushed metal too; and what stands behind a box, which is a flat picture, seen as
    if the gel reached to it, in a light that falls on it from above and before.

    Two renderers of one rig and appearance draw the same images, bit for bit, whatever was drawn
    before and on however many cores.

    Parameters
    ----------
    mitsuba : Mitsuba
        As `load_mitsuba` gives it.
    rig : StereoRig
        Cameras and phantom.
    look : Appearance
        Metal, light, floor, dirt, and the seed of all that is random.
    """

    def __init__(self, mitsuba: Mitsuba, rig: StereoRig, look: Appearance) -> None:
        self._mitsuba, self._rig, self._look = mitsuba, rig, look
        self._world = make_world(rig, look)
        self._tracer = PathTracer(mitsuba)
        self._still = Scene(mitsuba, self._world)
        self._moving: Scene | None = None
        self._bent: NeedleMesh | None = None
        self._light: dict[Backdrop, FloatImage] = {}
        for behind in dict.fromkeys(self._world.backdrops):
            (light,) = self._tracer.floor_light(
                [self._still],
                _grid(behind).reshape(-1, 3),
                samples=_FLOOR_SAMPLES,
                key=[look.seed],
            )
            # One sample's noise is finer than any shade of still things.
            self._light[behind] = cv2.GaussianBlur(
                light.reshape(_GRID_SHAPE).astype(np.float32), (0, 0), 1.5
            )
        cameras = zip((rig.left, rig.right), self._world.backdrops, strict=True)
        self._views = [self._view(*each, side) for side, each in enumerate(cameras)]
        rng = np.random.default_rng([look.seed, 0, _GAIN_STREAM])
        self._black = float(rng.uniform(*_BLACK))
        # What is before the phantom counts for no exposure.
        medians = [np.median(view.floor[view.floor_points[..., 2] > 0.0]) for view in self._views]
        self._gains = (
            (look.floor_level - self._black) / np.array(medians) * rng.normal(1.0, 0.03, 2)
        )

    def render(
        self, needles: tuple[NeedleMesh, NeedleMesh] | None, exposure_number: int
    ) -> tuple[GreyImage, GreyImage]:
        """Return the images of one exposure.

        Parameters
        ----------
        needles : pair of NeedleMesh or None
            As it is when left and right expose; None is not there.
        exposure_number : int
            Keys the noise; not negative.

        Returns
        -------
        left, right : ndarray of uint8, shape (image_height, image_width)
            Grey images.
        """
        look = self._look
        light = flicker(look, exposure_number)
        images = []
        for side, view in enumerate(self._views):
            key = [look.seed, exposure_number, side]
            image = self._exposed(view, needles and needles[side], key)
            rng = np.random.default_rng(key)
            grey = np.asarray(image * (self._gains[side] * light), dtype=np.float32)
            images.append(grey_image(grey, look, self._black, rng))
        left, right = images
        return left, right

    def _scene_with(self, needle: NeedleMesh) -> Scene:
        if self._moving is None:
            self._moving = Scene(self._mitsuba, self._world, needle.parts)
        elif needle is not self._bent:
            self._moving.bend(needle.parts)
        self._bent = needle
        return self._moving

    def _shadow(self, scene: Scene, behind: Backdrop, key: list[int]) -> FloatImage:
        """Return which share of the light on the grid the needle leaves."""
        without, beside = self._tracer.floor_light(
            [self._still, scene],
            _grid(behind).reshape(-1, 3),
            samples=_SHADOW_SAMPLES,
            key=key,
        )
        left = beside / np.maximum(without, 1e-9)
        image = left.reshape(_GRID_SHAPE).astype(np.float32)
        return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.7), dtype=np.float32)

    def _exposed(self, view: _View, needle: NeedleMesh | None, key: list[int]) -> FloatImage:
        floor, light, cover = view.floor, view.light, view.cover
        if needle is not None:
            scene = self._scene_with(needle)
            # A lit panel outshines the lamps' shadows.
            if self._look.floor != "panel":
                floor = floor * view.on_grid(self._shadow(scene, view.behind, key[:2]))
            pixels = _needle_pixels(view.optics, needle)
            light, cover = light.copy(), cover.copy()
            self._trace(view, scene, pixels, light, cover, samples=_NEEDLE_SAMPLES, key=key)
        return np.asarray((1.0 - cover) * floor + light, dtype=np.float32)

    def _trace(
        self,
        view: _View,
        scene: Scene,
        pixels: NDArray[np.int64],
        light: FloatImage,
        cover: FloatImage,
        *,
        samples: int,
        key: list[int],
    ) -> None:
        """Put what pixels, (N, 2), show before the backdrop into light and cover."""
        there = (pixels[:, 1], pixels[:, 0])
        seen, covered, way = self._tracer.layer(
            scene, pixels, view.optics.camera, self._rig, samples=samples, key=key
        )
        clear = _clearness(self._look.haze, way / np.maximum(covered, 1e-9) / view.behind.gel)
        clear = np.where(view.in_air[there], 1.0, clear)
        light[there] = clear * seen + (1.0 - clear) * covered * view.veil
        cover[there] = covered

    def _view(self, camera: SimulatedCamera, behind: Backdrop, side: int) -> _View:
        look, rig = self._look, self._rig
        optics = Optics(camera, None)
        size = (camera.image_height, camera.image_width)
        row, column = np.mgrid[: size[0], : size[1]]
        pixels = np.stack([column, row], axis=-1)
        rays = refracted_rays(pixels, camera, rig)
        points = behind.intersect(rays.origin, rays.direction)
        blank = np.zeros(size, dtype=np.float32)
        view = _View(optics, behind, points, rays.in_air, 0.0, blank, blank.copy(), blank.copy())
        floor = view.on_grid(self._light[behind])
        # The mean over each pixel: a quarter of the way to the next one, in both directions.
        right, down = (np.gradient(points, axis=axis) / 4.0 for axis in (1, 0))
        quarters = [
            behind.reflectance(points + u * right + v * down)
            for u in (-1.0, 1.0)
            for v in (-1.0, 1.0)
        ]
        if look.floor == "panel":
            floor += PANEL_RADIANCE / ALBEDO["panel"]
        floor = floor * np.mean(quarters, axis=0)
        if look.floor_blur_px > 0.0:
            floor = cv2.GaussianBlur(floor, (0, 0), look.floor_blur_px)
        veil = float(np.median(floor))
        clear = np.where(rays.in_air, 1.0, _clearness(look.haze, 1.0))
        floor = np.asarray(clear * floor + (1.0 - clear) * veil, dtype=np.float32)
        # Clouded gel scatters light from all sides, over a dark floor little of it.
        Marks(self._world).draw(floor, optics, 0.4 * float(np.median(self._light[behind])) + veil)

        view = dataclasses.replace(view, veil=veil, floor=floor)
        found = self._tracer.covered(self._still, pixels.reshape(-1, 2), camera, rig).reshape(size)
        around = np.ones((2 * _MARGIN_PX + 1,) * 2, dtype=np.uint8)
        near = cv2.dilate(found.astype(np.uint8), around) > 0
        self._trace(
            view,
            self._still,
            pixels[near],
            view.light,
            view.cover,
            samples=_STILL_SAMPLES,
            key=[look.seed, side],
        )
        return view


@dataclasses.dataclass(frozen=True, eq=False)
class _View:
    """Still part of one camera's image.

    Attributes
    ----------
    optics : Optics
        Where the camera sees points.
    behind : Backdrop
        What it sees behind the needle.
    floor_points : ndarray, shape (rows, columns, 3)
        Where lines of sight meet that, in `rig` [m].
    in_air : ndarray of bool, shape (rows, columns)
        Which of them pass the phantom by.
    veil : float
        Radiance of haze.
    floor : ndarray of float32, shape (rows, columns)
        The backdrop's radiance without a needle.
    light, cover : ndarray of float32, shape (rows, columns)
        Radiance and share of what stands before it.
    """

    optics: Optics
    behind: Backdrop
    floor_points: FloatArray
    in_air: NDArray[np.bool_]
    veil: float
    floor: FloatImage
    light: FloatImage
    cover: FloatImage

    def on_grid(self, values: FloatImage) -> FloatImage:
        """Return values of the backdrop's grid where lines of sight meet it, (rows, columns)."""
        aside, along = self.floor_points @ self.behind.sideways, self.floor_points[..., 2]
        column = ((along - _REACH[0]) / _SPACING).astype(np.float32)
        row = ((aside + _SIDE) / _SPACING).astype(np.float32)
        there = cv2.remap(values, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(there, dtype=np.float32)


def _clearness(haze: float, way: FloatArray | float) -> FloatArray:
    """Return the share of light left after a share of the way through the phantom."""
    return np.asarray((1.0 - haze) ** np.minimum(way, 1.0))


def _needle_pixels(optics: Optics, needle: NeedleMesh) -> NDArray[np.int64]:
    """Return the pixels, (N, 2), that show the needle or are next to such."""
    width, height = optics.image_size
    place = np.rint(optics.project(needle.parts["shaft"].points)).astype(np.int64)
    inside = np.all((place >= 0) & (place < [width, height]), axis=1)
    near = np.zeros((height, width), dtype=np.uint8)
    near[place[inside, 1], place[inside, 0]] = 1
    # From one ring of the tube to the next it is a few pixels.
    near = cv2.dilate(near, np.ones((9, 9), dtype=np.uint8))
    return np.stack(np.nonzero(near)[::-1], axis=-1).astype(np.int64)


def _grid(behind: Backdrop) -> FloatArray:
    """Return places of a backdrop in `rig`, (*_GRID_SHAPE, 3): rows across the needle [m]."""
    aside, along = np.mgrid[: _GRID_SHAPE[0], : _GRID_SHAPE[1]]
    return behind.points(aside * _SPACING - _SIDE, along * _SPACING + _REACH[0])
