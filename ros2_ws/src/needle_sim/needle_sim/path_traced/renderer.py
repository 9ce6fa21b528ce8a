"""Stereo images of a metal needle in a phantom: traced layers over a floor, then the camera."""

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
from needle_sim.path_traced.path_tracing import PathTracer
from needle_sim.path_traced.refracted_rays import points_at_height, refracted_rays
from needle_sim.path_traced.scene import Scene
from needle_sim.path_traced.sensor import flicker, grey_image
from needle_sim.path_traced.tracer import Mitsuba
from needle_sim.path_traced.world import PANEL_RADIANCE, make_world

_GAIN_STREAM = 33
# Paths a pixel of the needle, of what stands still, and of each place of the floor.
_NEEDLE_SAMPLES = 96
_STILL_SAMPLES = 24
_FLOOR_SAMPLES = 192
_SHADOW_SAMPLES = 48
# What the floor's light is sampled over [m]: y, z; spacing.
_SIDE = 0.072
_REACH = (-0.03, 0.15)
_SPACING = 0.00075
# How far around what stands before the floor pixels are traced [px].
_MARGIN_PX = 2
_BLACK = (0.0, 8.0)


class PathTracedRenderer:
    """Draws a metal needle as both cameras see it.

    An image is made of layers. The floor is its picture times the light on it, which is sampled on
    a grid, with and without the needle, so that the needle's shadow is there. What stands before
    the floor (needle, bubbles, walls) is path-traced where it is, with its share of each pixel.
    Lint and old paths are drawn on the floor's layer. Then come haze, blur, blooming and noise.

    Exact are shape and place of all that is traced: lines of sight obey Snell's law at the endless
    top of the phantom, which begins at z = 0. Approximated are: light inside the phantom, which
    comes straight from lamps that stand where the phantom's middle sees them; what the surface
    mirrors back into the phantom, a ring of one brightness; light that the floor gets from walls
    and needle, none; caustics of bubbles, which only throw shadows; haze, an operation on the
    image; the surface's own reflections, none; and a floor that is Lambertian, brushed metal too.

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
        self._grid = _floor_grid(look.floor_height)
        points = self._grid.reshape(-1, 3)
        (light,) = self._tracer.floor_light(
            [self._still], points, samples=_FLOOR_SAMPLES, key=[look.seed]
        )
        # One sample's noise is finer than any shade of still things.
        self._light = cv2.GaussianBlur(
            light.reshape(self._grid.shape[:2]).astype(np.float32), (0, 0), 1.5
        )
        cameras = (rig.left, rig.right)
        self._views = [self._view(camera, side) for side, camera in enumerate(cameras)]
        # What is before the phantom counts for no exposure.
        inside = np.concatenate(
            [view.floor[view.floor_points[..., 2] > 0.0] for view in self._views]
        )
        rng = np.random.default_rng([look.seed, 0, _GAIN_STREAM])
        self._black = float(rng.uniform(*_BLACK))
        gain = (look.floor_level - self._black) / float(np.median(inside))
        self._gains = gain * rng.normal(1.0, 0.03, 2)

    def render(
        self, needle: NeedleMesh | None, exposure_number: int
    ) -> tuple[GreyImage, GreyImage]:
        """Return the images of one exposure.

        Parameters
        ----------
        needle : NeedleMesh or None
            None is not there.
        exposure_number : int
            Keys the noise; not negative.

        Returns
        -------
        left, right : ndarray of uint8, shape (image_height, image_width)
            Grey images.
        """
        look, scene, shadow = self._look, self._still, None
        if needle is not None:
            scene = self._scene_with(needle)
            # A lit panel outshines the lamps' shadows.
            if look.floor != "panel":
                shadow = self._shadow(scene, [look.seed, exposure_number])
        light = flicker(look, exposure_number)
        images = []
        for side, view in enumerate(self._views):
            key = [look.seed, exposure_number, side]
            image = self._exposed(view, scene, needle, shadow, key)
            rng = np.random.default_rng(key)
            grey = np.asarray(image * (self._gains[side] * light), dtype=np.float32)
            images.append(grey_image(grey, look, self._black, rng))
        left, right = images
        return left, right

    def _scene_with(self, needle: NeedleMesh) -> Scene:
        if self._moving is None:
            self._moving = Scene(self._mitsuba, self._world, needle.parts)
        else:
            self._moving.bend(needle.parts)
        return self._moving

    def _shadow(self, scene: Scene, key: list[int]) -> FloatImage:
        """Return which share of the light on the grid the needle leaves."""
        without, beside = self._tracer.floor_light(
            [self._still, scene], self._grid.reshape(-1, 3), samples=_SHADOW_SAMPLES, key=key
        )
        left = beside / np.maximum(without, 1e-9)
        image = left.reshape(self._grid.shape[:2]).astype(np.float32)
        return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.7), dtype=np.float32)

    def _exposed(
        self,
        view: _View,
        scene: Scene,
        needle: NeedleMesh | None,
        shadow: FloatImage | None,
        key: list[int],
    ) -> FloatImage:
        floor, light, cover = view.floor, view.light, view.cover
        if shadow is not None:
            floor = floor * _on_grid(shadow, view.floor_points)
        if needle is not None:
            pixels = _needle_pixels(view.optics, needle)
            traced = self._tracer.layer(
                scene, pixels, view.camera, self._rig, samples=_NEEDLE_SAMPLES, key=key
            )
            light, cover = light.copy(), cover.copy()
            light[pixels[:, 1], pixels[:, 0]], cover[pixels[:, 1], pixels[:, 0]] = traced
        return np.asarray((1.0 - cover) * floor + light, dtype=np.float32)

    def _view(self, camera: SimulatedCamera, side: int) -> _View:
        look, rig = self._look, self._rig
        optics = Optics(camera, None)
        size = (camera.image_height, camera.image_width)
        row, column = np.mgrid[: size[0], : size[1]]
        pixels = np.stack([column, row], axis=-1)
        points = points_at_height(refracted_rays(pixels, camera, rig), look.floor_height)
        floor = _on_grid(self._light, points)
        # The mean over each pixel: a quarter of the way to the next one, in both directions.
        right, down = (np.gradient(points, axis=axis) / 4.0 for axis in (1, 0))
        quarters = [
            self._world.picture.at(points + u * right + v * down)
            for u in (-1.0, 1.0)
            for v in (-1.0, 1.0)
        ]
        if look.floor == "panel":
            floor += PANEL_RADIANCE / ALBEDO["panel"]
        floor = floor * np.mean(quarters, axis=0)
        if look.floor_blur_px > 0.0:
            floor = cv2.GaussianBlur(floor, (0, 0), look.floor_blur_px)
        # Clouded gel scatters light from all sides, over a dark floor little of it.
        white = 0.4 * float(np.median(self._light)) + float(np.median(floor))
        Marks(look, rig).draw(floor, optics, white)

        flat = pixels.reshape(-1, 2)
        found = self._tracer.covered(self._still, flat, camera, rig).reshape(size)
        around = np.ones((2 * _MARGIN_PX + 1,) * 2, dtype=np.uint8)
        near = cv2.dilate(found.astype(np.uint8), around) > 0
        light, cover = np.zeros(size, dtype=np.float32), np.zeros(size, dtype=np.float32)
        light[near], cover[near] = self._tracer.layer(
            self._still,
            pixels[near],
            camera,
            rig,
            samples=_STILL_SAMPLES,
            key=[look.seed, side],
        )
        return _View(camera, optics, points, np.asarray(floor, dtype=np.float32), light, cover)


@dataclasses.dataclass(frozen=True, eq=False)
class _View:
    """Still part of one camera's image.

    Attributes
    ----------
    camera : SimulatedCamera
        Who sees it.
    optics : Optics
        Where it sees points.
    floor_points : ndarray, shape (rows, columns, 3)
        Where lines of sight meet the floor, in `rig` [m].
    floor : ndarray of float32, shape (rows, columns)
        The floor's radiance without a needle.
    light, cover : ndarray of float32, shape (rows, columns)
        Radiance and share of what stands before the floor.
    """

    camera: SimulatedCamera
    optics: Optics
    floor_points: FloatArray
    floor: FloatImage
    light: FloatImage
    cover: FloatImage


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


def _floor_grid(height: float) -> FloatArray:
    """Return places of the floor, (rows, columns, 3): rows along y, columns along z [m]."""
    y = np.arange(-_SIDE, _SIDE, _SPACING)
    z = np.arange(*_REACH, _SPACING)
    grid = np.empty((len(y), len(z), 3))
    grid[..., 0] = height
    grid[..., 1] = y[:, np.newaxis]
    grid[..., 2] = z
    return grid


def _on_grid(values: FloatImage, points: FloatArray) -> FloatImage:
    """Return values of the floor's grid at points, (..., 3) [m]."""
    column = ((points[..., 2] - _REACH[0]) / _SPACING).astype(np.float32)
    row = ((points[..., 1] + _SIDE) / _SPACING).astype(np.float32)
    there = cv2.remap(values, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(there, dtype=np.float32)
