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
from needle_sim.path_traced.appearance import ALBEDO, Appearance
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
# Light beyond this causes no wider bloom, because the sensor drains it.
_MAX_LIGHT = 6.0 * _FULL


def flicker(appearance: Appearance, number: int) -> float:
    """Return the factor of an exposure's light, for both cameras."""
    rng = np.random.default_rng([appearance.seed, number, 40])
    return float(np.exp(appearance.flicker * rng.standard_normal()))


def grey_image(
    light: FloatImage, appearance: Appearance, black: float, rng: np.random.Generator
) -> GreyImage:
    """Return the image of the sensor.

    Parameters
    ----------
    light : ndarray of float32, shape (rows, columns)
        Light in grey levels, without an upper bound.
    appearance : Appearance
        Haze, blur, blooming and noise.
    black : float
        Black level of the sensor [grey levels].
    rng : numpy.random.Generator
        Generator of the noise.
    """
    image = np.minimum(light, _MAX_LIGHT).astype(np.float32)
    if appearance.haze > 0.0:
        # Forward scattering reduces the contrast of small objects.
        glow = cv2.GaussianBlur(image, (0, 0), _HAZE_BLUR_PX)
        image += 0.5 * appearance.haze * (glow - image)
    image = cv2.GaussianBlur(image, (0, 0), appearance.blur_px)
    if appearance.bloom > 0.0:
        beyond = np.maximum(image - _FULL, 0.0)
        around = cv2.GaussianBlur(beyond, (0, 0), _BLOOM_BLUR_PX)
        column = cv2.GaussianBlur(beyond, (1, 0), sigmaX=1e-3, sigmaY=_BLOOM_ALONG_PX)
        image += appearance.bloom * (6.0 * around + 6.0 * column)
    image += black
    spread = np.sqrt(
        appearance.noise**2 + appearance.shot_noise**2 * np.clip(image, 0.0, _FULL) / _FULL,
        dtype=np.float32,
    )
    image += spread * rng.standard_normal(image.shape, dtype=np.float32)
    return np.asarray(np.clip(np.rint(image), 0.0, _FULL), dtype=np.uint8)


_GAIN_STREAM = 33
# Paths per pixel of the needle and of static objects, and per point of the floor.
_NEEDLE_SAMPLES = 96
_STATIC_SAMPLES = 64
_FLOOR_SAMPLES = 192
_SHADOW_SAMPLES = 48
# Grid of the floor's light: half width across the needle, range along it, spacing [m].
_SIDE = 0.072
_REACH = (-0.03, 0.15)
_SPACING = 0.00075
_GRID_SHAPE = (round(2.0 * _SIDE / _SPACING), round((_REACH[1] - _REACH[0]) / _SPACING))
# Margin around static objects in which pixels are traced [px].
_MARGIN_PX = 2
_BLACK = (0.0, 8.0)


class PathTracedRenderer:
    """Renders a metal needle in both cameras.

    An image consists of layers. The backdrop (the floor, or the background of a clear box) is its
    picture times the light on it, which is sampled on a grid with and without the needle, for the
    needle's shadow. Objects in front of it (needle, bubbles, walls) are path-traced, with their
    share of each pixel. Lint, earlier paths and the edges of a box are drawn on the backdrop. Haze
    fades all layers by their distance; its glow, blur, blooming and noise are applied last.

    Shape and position of all traced objects are exact: lines of sight obey Snell's law at each
    layer of a camera's window; the phantom begins at z = 0, a box ends at its walls.
    Approximations: lamps are where they appear from the phantom's centre through a level
    top, also for a box; the surface mirrors a ring of constant brightness into the phantom, but not
    into a box; walls and needle do not light the floor; bubbles cast shadows without caustics; haze
    is one exponential with a glow of one width; windows do not reflect; all floors are Lambertian;
    the background of a box is a flat picture in gel, lit from above and from the front.

    Renderers with the same rig and appearance produce bit-identical images, in any order and on any
    number of cores.

    Parameters
    ----------
    mitsuba : Mitsuba
        Result of `load_mitsuba`.
    rig : StereoRig
        Cameras and phantom.
    appearance : Appearance
        Appearance, with the seed of all random numbers.
    """

    def __init__(self, mitsuba: Mitsuba, rig: StereoRig, appearance: Appearance) -> None:
        self._mitsuba, self._rig, self._look = mitsuba, rig, appearance
        self._world = make_world(rig, appearance)
        self._tracer = PathTracer(mitsuba, rig)
        self._static_scene = Scene(mitsuba, self._world)
        self._needle_scene: Scene | None = None
        self._current_needle: NeedleMesh | None = None
        self._light: dict[Backdrop, FloatImage] = {}
        for behind in dict.fromkeys(self._world.backdrops):
            (light,) = self._tracer.floor_light(
                [self._static_scene],
                _grid(behind).reshape(-1, 3),
                samples=_FLOOR_SAMPLES,
                key=[appearance.seed],
            )
            # Sampling noise is finer than the shadows of static objects.
            self._light[behind] = cv2.GaussianBlur(
                light.reshape(_GRID_SHAPE).astype(np.float32), (0, 0), 1.5
            )
        cameras = zip((rig.left, rig.right), self._world.backdrops, strict=True)
        self._views = [self._view(*each, side) for side, each in enumerate(cameras)]
        rng = np.random.default_rng([appearance.seed, 0, _GAIN_STREAM])
        self._black = float(rng.uniform(*_BLACK))
        # Exposure ignores the area in front of the phantom.
        medians = [np.median(view.floor[view.floor_points[..., 2] > 0.0]) for view in self._views]
        self._gains = (
            (appearance.floor_level - self._black) / np.array(medians) * rng.normal(1.0, 0.03, 2)
        )

    def render(
        self, needles: tuple[NeedleMesh, NeedleMesh] | None, exposure_number: int
    ) -> tuple[GreyImage, GreyImage]:
        """Return the images of one exposure.

        Parameters
        ----------
        needles : pair of NeedleMesh or None
            Needle at the exposures of left and right; None without a needle.
        exposure_number : int
            Key of the noise, not negative.

        Returns
        -------
        left, right : ndarray of uint8, shape (image_height, image_width)
            Grey images.
        """
        appearance = self._look
        light = flicker(appearance, exposure_number)
        images = []
        for side, view in enumerate(self._views):
            key = [appearance.seed, exposure_number, side]
            image = self._exposed(view, needles and needles[side], key)
            rng = np.random.default_rng(key)
            grey = np.asarray(image * (self._gains[side] * light), dtype=np.float32)
            images.append(grey_image(grey, appearance, self._black, rng))
        left, right = images
        return left, right

    def _scene_with(self, needle: NeedleMesh) -> Scene:
        if self._needle_scene is None:
            self._needle_scene = Scene(self._mitsuba, self._world, needle.parts)
        elif needle is not self._current_needle:
            self._needle_scene.update_needle(needle.parts)
        self._current_needle = needle
        return self._needle_scene

    def _shadow(self, scene: Scene, behind: Backdrop, key: list[int]) -> FloatImage:
        """Return the share of the grid's light that the needle does not block."""
        without, beside = self._tracer.floor_light(
            [self._static_scene, scene],
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
            # Shadows are invisible on a lit panel.
            if self._look.floor != "panel":
                floor = floor * view.on_grid(self._shadow(scene, view.backdrop, key[:2]))
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
        """Set light and cover of pixels, (N, 2), that show objects in front of the backdrop."""
        there = (pixels[:, 1], pixels[:, 0])
        radiance, covered, distance = self._tracer.layer(
            scene, pixels, view.optics.camera, samples=samples, key=key
        )
        path_share = distance / np.maximum(covered, 1e-9) / view.backdrop.gel
        clear = _transmission(self._look.haze, path_share)
        clear = np.where(view.in_air[there], 1.0, clear)
        light[there] = clear * radiance + (1.0 - clear) * covered * view.veil
        cover[there] = covered

    def _view(self, camera: SimulatedCamera, behind: Backdrop, side: int) -> _View:
        appearance, rig = self._look, self._rig
        optics = Optics(camera, None)
        size = (camera.image_height, camera.image_width)
        row, column = np.mgrid[: size[0], : size[1]]
        pixels = np.stack([column, row], axis=-1)
        rays = refracted_rays(pixels, camera, rig)
        points = behind.intersect(rays.origin, rays.direction)
        blank = np.zeros(size, dtype=np.float32)
        view = _View(optics, behind, points, rays.in_air, 0.0, blank, blank.copy(), blank.copy())
        floor = view.on_grid(self._light[behind])
        # Mean over each pixel, from four samples.
        right, down = (np.gradient(points, axis=axis) / 4.0 for axis in (1, 0))
        quarters = [
            behind.reflectance(points + u * right + v * down)
            for u in (-1.0, 1.0)
            for v in (-1.0, 1.0)
        ]
        if appearance.floor == "panel":
            floor += PANEL_RADIANCE / ALBEDO["panel"]
        floor = floor * np.mean(quarters, axis=0)
        if appearance.floor_blur_px > 0.0:
            floor = cv2.GaussianBlur(floor, (0, 0), appearance.floor_blur_px)
        veil = float(np.median(floor))
        clear = np.where(rays.in_air, 1.0, _transmission(appearance.haze, 1.0))
        floor = np.asarray(clear * floor + (1.0 - clear) * veil, dtype=np.float32)
        # Cloudy gel scatters light from all sides; over a dark floor there is little of it.
        Marks(self._world).draw(floor, optics, 0.4 * float(np.median(self._light[behind])) + veil)

        view = dataclasses.replace(view, veil=veil, floor=floor)
        found = self._tracer.covered(self._static_scene, pixels.reshape(-1, 2), camera)
        around = np.ones((2 * _MARGIN_PX + 1,) * 2, dtype=np.uint8)
        near = cv2.dilate(found.reshape(size).astype(np.uint8), around) > 0
        self._trace(
            view,
            self._static_scene,
            pixels[near],
            view.light,
            view.cover,
            samples=_STATIC_SAMPLES,
            key=[appearance.seed, side],
        )
        return view


@dataclasses.dataclass(frozen=True, eq=False)
class _View:
    """Static part of a camera's image.

    Attributes
    ----------
    optics : Optics
        Optics of the camera.
    backdrop : Backdrop
        Backdrop of the camera.
    floor_points : ndarray, shape (rows, columns, 3)
        Intersections of the lines of sight with the backdrop, in `rig` [m].
    in_air : ndarray of bool, shape (rows, columns)
        Whether a line of sight misses the phantom.
    veil : float
        Radiance of haze.
    floor : ndarray of float32, shape (rows, columns)
        Radiance of the backdrop without a needle.
    light, cover : ndarray of float32, shape (rows, columns)
        Radiance and coverage of objects in front of the backdrop.
    """

    optics: Optics
    backdrop: Backdrop
    floor_points: FloatArray
    in_air: NDArray[np.bool_]
    veil: float
    floor: FloatImage
    light: FloatImage
    cover: FloatImage

    def on_grid(self, values: FloatImage) -> FloatImage:
        """Return values of the backdrop's grid at the lines of sight, (rows, columns)."""
        aside, along = self.floor_points @ self.backdrop.sideways, self.floor_points[..., 2]
        column = ((along - _REACH[0]) / _SPACING).astype(np.float32)
        row = ((aside + _SIDE) / _SPACING).astype(np.float32)
        there = cv2.remap(values, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(there, dtype=np.float32)


def _transmission(haze: float, path_share: FloatArray | float) -> FloatArray:
    """Return the transmitted share of light after a share of the path through the phantom."""
    return np.asarray((1.0 - haze) ** np.minimum(path_share, 1.0))


def _needle_pixels(optics: Optics, needle: NeedleMesh) -> NDArray[np.int64]:
    """Return the pixels, (N, 2), that show the needle, and their neighbours."""
    width, height = optics.image_size
    place = np.rint(optics.project(needle.parts["shaft"].points)).astype(np.int64)
    inside = np.all((place >= 0) & (place < [width, height]), axis=1)
    near = np.zeros((height, width), dtype=np.uint8)
    near[place[inside, 1], place[inside, 0]] = 1
    # The rings of the tube are a few pixels apart.
    near = cv2.dilate(near, np.ones((9, 9), dtype=np.uint8))
    return np.stack(np.nonzero(near)[::-1], axis=-1).astype(np.int64)


def _grid(behind: Backdrop) -> FloatArray:
    """Return the grid points of a backdrop in `rig`, (*_GRID_SHAPE, 3) [m]."""
    aside, along = np.mgrid[: _GRID_SHAPE[0], : _GRID_SHAPE[1]]
    return behind.points(aside * _SPACING - _SIDE, along * _SPACING + _REACH[0])
