"""Tracing of paths: what stands before the floor as a layer, and the light on the floor."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from needle_sim.camera.stereo_rig import SimulatedCamera, StereoRig
from needle_sim.needle.se3 import FloatArray
from needle_sim.path_traced.refracted_rays import refracted_rays
from needle_sim.path_traced.scene import Scene
from needle_sim.path_traced.tracer import MM, Mitsuba

PixelArray = NDArray[np.int64]

_DEPTH = 6
# No path counts more than this many times the brightest lamp's radiance: it would leave a spark.
_BRIGHTEST = 10.0
_MOST_PATHS = 4_000_000


class PathTracer:
    """Traces what a camera sees in a scene, and the light on its floor.

    Parameters
    ----------
    mitsuba : Mitsuba
        As `load_mitsuba` gives it.
    """

    def __init__(self, mitsuba: Mitsuba) -> None:
        self._mi, self._dr = mitsuba
        self._integrator = self._mi.load_dict({"type": "path", "max_depth": _DEPTH})

    def layer(
        self,
        scene: Scene,
        pixels: PixelArray,
        camera: SimulatedCamera,
        rig: StereoRig,
        *,
        samples: int,
        key: list[int],
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return light, coverage and distance of what stands before the floor.

        Parameters
        ----------
        scene : Scene
            What is there.
        pixels : ndarray of int, shape (N, 2)
            u, v of the pixels [px].
        camera : SimulatedCamera
            Who sees it.
        rig : StereoRig
            The phantom that it looks into.
        samples : int
            Paths a pixel, evenly over its area.
        key : list of int
            Keys them.

        Returns
        -------
        light : ndarray, shape (N,)
            Mean radiance of a pixel's paths, those that meet the floor first counted as 0.
        cover : ndarray, shape (N,)
            Share of the paths that meet something else first.
        way : ndarray, shape (N,)
            How far those go, on average over all paths: times `cover` the distance [m].
        """
        parts = [
            self._part(scene, part, camera, rig, samples=samples, key=[*key, number])
            for number, part in enumerate(
                np.array_split(pixels, max(1, -(-len(pixels) * samples // _MOST_PATHS)))
            )
            if len(part)
        ]
        if not parts:
            return np.zeros(0), np.zeros(0), np.zeros(0)
        light, cover, way = (np.concatenate(which) for which in zip(*parts, strict=True))
        return light, cover, way

    def covered(
        self, scene: Scene, pixels: PixelArray, camera: SimulatedCamera, rig: StereoRig
    ) -> NDArray[np.bool_]:
        """Return at which pixels, (N, 2), something stands before the floor, in their middle."""
        mi = self._mi
        rays = refracted_rays(pixels, camera, rig)
        origin = mi.Point3f(*(MM * rays.origin.T).astype(np.float32))
        direction = mi.Vector3f(*rays.direction.T.astype(np.float32))
        hit = scene.tracer.ray_intersect_preliminary(mi.Ray3f(origin, direction), coherent=True)
        before = self._before(hit, scene)
        return np.asarray(before, dtype=np.bool_)

    def floor_light(
        self, scenes: list[Scene], points: FloatArray, *, samples: int, key: list[int]
    ) -> list[FloatArray]:
        """Return the light that falls from above on places in each of several scenes.

        Only what comes straight from lamps and room counts. The scenes' light is sampled alike, so
        that their ratio shows what stands in the way and no noise.

        Parameters
        ----------
        scenes : list of Scene
            With the same lamps.
        points : ndarray, shape (N, 3)
            In `rig` [m].
        samples : int
            Paths for each point.
        key : list of int
            Keys them.

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
        # A floor throws no shadow: another camera's backdrop is no wall between lamp and box.
        blocked = [
            self._before(scene.tracer.ray_intersect_preliminary(ray), scene) for scene in scenes
        ]
        return [self._mean(self._dr.select(hidden, 0.0, light), samples) for hidden in blocked]

    def _part(
        self,
        scene: Scene,
        pixels: PixelArray,
        camera: SimulatedCamera,
        rig: StereoRig,
        *,
        samples: int,
        key: list[int],
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        mi = self._mi
        sampler = self._sampler(key, len(pixels) * samples)
        index = self._index(len(pixels), samples)
        # Within a pixel origin and direction are as good as linear.
        half = np.array([[0.5, 0.0], [0.0, 0.5]])
        middle = refracted_rays(pixels, camera, rig)
        right, left, down, up = (
            refracted_rays(pixels + shift, camera, rig)
            for shift in (half[0], -half[0], half[1], -half[1])
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
        before = self._before(hit, scene)
        light, _, _ = self._integrator.sample(scene.tracer, sampler, ray, None, before)
        cover = self._dr.select(before, mi.Float(1.0), 0.0)
        bounded = self._dr.select(before, self._dr.minimum(light.x, _BRIGHTEST), 0.0)
        way = self._dr.select(before, hit.t / MM, 0.0)
        mean = self._mean
        return mean(bounded, samples), mean(cover, samples), mean(way, samples)

    def _before(self, hit: Any, scene: Scene) -> Any:
        """Return which rays meet something, and not a floor."""
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
