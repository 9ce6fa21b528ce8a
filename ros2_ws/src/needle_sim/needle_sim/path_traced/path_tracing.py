"""Path tracing: refracted lines of sight, objects in front of the floor, light on the floor."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from needle_sim.camera.stereo_rig import SimulatedCamera, StereoRig
from needle_sim.needle.se3 import FloatArray
from needle_sim.path_traced.scene import Scene
from needle_sim.path_traced.tracer import MM, Mitsuba
from needle_sim.path_traced.world import LENGTH, is_box, reach_sideways

# Each iteration reduces the error of the lens distortion to less than a hundredth.
_UNDISTORTING_STEPS = 14


@dataclasses.dataclass(frozen=True, eq=False)
class Rays:
    """Lines of sight, from the points where they enter or miss the phantom.

    Attributes
    ----------
    origin : ndarray, shape (..., 3)
        Start on the window's inner face, in `rig`; on the outer face if the ray misses the phantom
        [m].
    direction : ndarray, shape (..., 3)
        Unit vector in `rig`, behind that face.
    in_air : ndarray of bool, shape (...)
        Whether the line of sight misses the phantom and is not refracted.
    """

    origin: FloatArray
    direction: FloatArray
    in_air: NDArray[np.bool_]


def refracted_rays(pixels: ArrayLike, camera: SimulatedCamera, rig: StereoRig) -> Rays:
    """Return the lines of sight of pixels.

    The phantom begins at z = 0, where the needle enters. A shared surface has no other bounds; the
    wall of a box ends at the other walls.

    Parameters
    ----------
    pixels : array_like, shape (..., 2)
        u, v [px]; whole numbers are pixel centres.
    camera : SimulatedCamera
        Camera of the rig.
    rig : StereoRig
        Rig with the phantom.

    Returns
    -------
    Rays
        One ray per pixel.
    """
    pixels = np.asarray(pixels, dtype=np.float64)
    pose, window = camera.T_optical_rig, camera.window
    sight = np.ones((*pixels.shape[:-1], 3))
    sight[..., :2] = _undistorted(pixels, camera)
    incoming = sight @ pose[:3, :3]
    incoming /= np.linalg.norm(incoming, axis=-1, keepdims=True)

    inwards = incoming @ window.normal
    length = (window.outer - window.height(camera.centre)) / inwards
    outer = camera.centre + length[..., np.newaxis] * incoming
    # Snell: the tangential component shrinks by n, the normal one completes the unit length.
    flat = incoming - inwards[..., np.newaxis] * window.normal
    origin = outer
    for thickness, index in zip(window.thicknesses, window.indices, strict=False):
        direction = _refracted(flat / index, window.normal)
        origin = origin - thickness / (direction @ window.normal)[..., np.newaxis] * direction
    direction = _refracted(flat / window.indices[-1], window.normal)

    in_air = origin[..., 2] <= 0.0
    if is_box(rig):
        beside = np.abs(origin @ window.sideways) >= reach_sideways(camera, rig)
        in_air |= (origin[..., 2] >= LENGTH) | beside
    straight = in_air[..., np.newaxis]
    return Rays(np.where(straight, outer, origin), np.where(straight, incoming, direction), in_air)


def _refracted(flat: FloatArray, normal: FloatArray) -> FloatArray:
    """Return unit vectors against a normal, with the tangential component `flat`, (..., 3)."""
    return np.asarray(flat - np.sqrt(1.0 - (flat**2).sum(axis=-1))[..., np.newaxis] * normal)


def _undistorted(pixels: FloatArray, camera: SimulatedCamera) -> FloatArray:
    """Return normalized image coordinates: the inverse of plumb_bob by fixed-point iteration."""
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


PixelArray = NDArray[np.int64]

_DEPTH = 6
# Upper bound of a path's radiance, in units of the brightest lamp, to avoid bright outliers.
_MAX_RADIANCE = 10.0
_MAX_PATHS = 4_000_000


class PathTracer:
    """Path-traces the view of a camera, and the light on the floor.

    Parameters
    ----------
    mitsuba : Mitsuba
        Result of `load_mitsuba`.
    rig : StereoRig
        Rig with the phantom.
    """

    def __init__(self, mitsuba: Mitsuba, rig: StereoRig) -> None:
        self._mi, self._dr = mitsuba
        self._rig = rig
        self._integrator = self._mi.load_dict({"type": "path", "max_depth": _DEPTH})

    def layer(
        self,
        scene: Scene,
        pixels: PixelArray,
        camera: SimulatedCamera,
        *,
        samples: int,
        key: list[int],
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return light, coverage and distance of the objects in front of the floor.

        Parameters
        ----------
        scene : Scene
            Scene to trace.
        pixels : ndarray of int, shape (N, 2)
            u, v of the pixels [px].
        camera : SimulatedCamera
            Camera of the view.
        samples : int
            Number of paths per pixel, uniform over its area.
        key : list of int
            Seed of the paths.

        Returns
        -------
        light : ndarray, shape (N,)
            Mean radiance of a pixel's paths; paths that hit the floor first count as 0.
        cover : ndarray, shape (N,)
            Share of the paths that hit another object first.
        distance : ndarray, shape (N,)
            Length of these paths, averaged over all paths: distance times `cover` [m].
        """
        parts = [
            self._part(scene, part, camera, samples=samples, key=[*key, number])
            for number, part in enumerate(
                np.array_split(pixels, max(1, -(-len(pixels) * samples // _MAX_PATHS)))
            )
            if len(part)
        ]
        if not parts:
            return np.zeros(0), np.zeros(0), np.zeros(0)
        light, cover, distance = (np.concatenate(which) for which in zip(*parts, strict=True))
        return light, cover, distance

    def covered(
        self, scene: Scene, pixels: PixelArray, camera: SimulatedCamera
    ) -> NDArray[np.bool_]:
        """Return whether each pixel, (N, 2), shows an object in front of the floor."""
        mi = self._mi
        rays = refracted_rays(pixels, camera, self._rig)
        origin = mi.Point3f(*(MM * rays.origin.T).astype(np.float32))
        direction = mi.Vector3f(*rays.direction.T.astype(np.float32))
        hit = scene.tracer.ray_intersect_preliminary(mi.Ray3f(origin, direction), coherent=True)
        before = self._hits_object(hit, scene)
        return np.asarray(before, dtype=np.bool_)

    def floor_light(
        self, scenes: list[Scene], points: FloatArray, *, samples: int, key: list[int]
    ) -> list[FloatArray]:
        """Return the direct light from above on points, in each of several scenes.

        The light comes from lamps and room without reflections. All scenes use the same samples, so
        that their ratio shows shadows without noise.

        Parameters
        ----------
        scenes : list of Scene
            Scenes with the same lamps.
        points : ndarray, shape (N, 3)
            Points in `rig` [m].
        samples : int
            Number of paths per point.
        key : list of int
            Seed of the paths.

        Returns
        -------
        list of ndarray, shape (N,)
            Irradiance over pi: the radiance of a white floor.
        """
        mi = self._mi
        sampler = self._sampler(key, len(points) * samples)
        index = self._index(len(points), samples)
        at = self._dr.zeros(mi.SurfaceInteraction3f, len(points) * samples)
        at.p = self._gather(MM * points, index)
        at.n = mi.Normal3f(1.0, 0.0, 0.0)
        towards, weight = scenes[0].tracer.sample_emitter_direction(
            at, sampler.next_2d(), test_visibility=False
        )
        light = weight.x * self._dr.maximum(towards.d.x, 0.0) / np.pi
        ray = at.spawn_ray_to(towards.p)
        # Floors cast no shadows: the backdrop of the other camera is not a real wall.
        blocked = [
            self._hits_object(scene.tracer.ray_intersect_preliminary(ray), scene)
            for scene in scenes
        ]
        return [self._mean(self._dr.select(hidden, 0.0, light), samples) for hidden in blocked]

    def _part(
        self,
        scene: Scene,
        pixels: PixelArray,
        camera: SimulatedCamera,
        *,
        samples: int,
        key: list[int],
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        mi = self._mi
        sampler = self._sampler(key, len(pixels) * samples)
        index = self._index(len(pixels), samples)
        # Origin and direction are practically linear within a pixel.
        half = np.array([[0.5, 0.0], [0.0, 0.5]])
        middle, right, left, down, up = (
            refracted_rays(pixels + shift, camera, self._rig)
            for shift in (np.zeros(2), half[0], -half[0], half[1], -half[1])
        )
        place = sampler.next_2d() - 0.5
        origin = (
            self._gather(MM * middle.origin, index)
            + place.x * self._gather(MM * (right.origin - left.origin), index)
            + place.y * self._gather(MM * (down.origin - up.origin), index)
        )
        direction = (
            self._gather(middle.direction, index)
            + place.x * self._gather(right.direction - left.direction, index)
            + place.y * self._gather(down.direction - up.direction, index)
        )
        ray = mi.RayDifferential3f(
            mi.Ray3f(mi.Point3f(origin), mi.Vector3f(self._dr.normalize(direction)))
        )
        hit = scene.tracer.ray_intersect_preliminary(ray, coherent=True)
        before = self._hits_object(hit, scene)
        light, _, _ = self._integrator.sample(scene.tracer, sampler, ray, None, before)
        cover = self._dr.select(before, mi.Float(1.0), 0.0)
        bounded = self._dr.select(before, self._dr.minimum(light.x, _MAX_RADIANCE), 0.0)
        distance = self._dr.select(before, hit.t / MM, 0.0)
        mean = self._mean
        return mean(bounded, samples), mean(cover, samples), mean(distance, samples)

    def _hits_object(self, hit: Any, scene: Scene) -> Any:
        """Return which rays hit an object other than a floor."""
        before = hit.is_valid()
        for floor in scene.floors:
            before &= hit.shape != self._mi.ShapePtr(floor)
        return before

    def _sampler(self, key: list[int], size: int) -> Any:
        sampler = self._mi.load_dict({"type": "independent"})
        sampler.seed(int(np.random.SeedSequence(key).generate_state(1)[0]), size)
        return sampler

    def _index(self, count: int, samples: int) -> Any:
        return self._dr.arange(self._mi.UInt32, count * samples) // samples

    def _gather(self, points: FloatArray, index: Any) -> Any:
        flat = self._mi.Float(points.astype(np.float32).ravel())
        return self._dr.gather(self._mi.Vector3f, flat, index)

    @staticmethod
    def _mean(values: Any, samples: int) -> FloatArray:
        each = np.asarray(values).reshape(-1, samples)
        return np.asarray(each.mean(axis=1, dtype=np.float64))
