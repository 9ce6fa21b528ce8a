"""Scene for the path tracer: floor, box, bubbles, lamps, room and needle.

`refracted_rays` refracts the lines of sight, so that the scene has no surface: the light comes
directly from lamps at their apparent positions from the phantom's centre, and from the room as seen
from there.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from needle_sim.camera.clutter import BubbleCloud
from needle_sim.path_traced import floors
from needle_sim.path_traced.appearance import ALBEDO, Metal
from needle_sim.path_traced.needle_mesh import Mesh
from needle_sim.path_traced.tracer import MM, Mitsuba
from needle_sim.path_traced.world import (
    LENGTH,
    MIDDLE,
    PANEL_RADIANCE,
    Backdrop,
    World,
    apparent_centre,
    block_bounds,
    is_box,
    refractive_index,
    room_light,
)

# Steel at 580 nm, relative to air.
_STEEL_INDEX = 2.9
_STEEL_EXTINCTION = 3.1
_PAINT_INDEX = 1.5
_DARK: dict[Metal, float] = {"oxide": 0.05, "painted": 0.02}
_SHEATH_LENGTH = 0.04
_SHEATH_RADIUS = 0.0015
# The floor in the scene is visible only in reflections, at this coarser resolution.
_COARSER = 4


class Scene:
    """Mitsuba scene of a world, with or without a needle.

    Parameters
    ----------
    mitsuba : Mitsuba
        Result of `load_mitsuba`.
    world : World
        Static parts.
    needle : dict of str to Mesh, optional
        Parts of the needle; their shape may change later, but not their number.
    """

    def __init__(
        self, mitsuba: Mitsuba, world: World, needle: dict[str, Mesh] | None = None
    ) -> None:
        self._mi = mitsuba.mi
        parts: dict[str, Any] = {"type": "scene", **self._box(world), **self._light(world)}
        self.floors = [
            self._mi.load_dict(self._floor(world, behind))
            for behind in dict.fromkeys(world.backdrops)
        ]
        parts |= {f"floor_{number}": shape for number, shape in enumerate(self.floors)}
        if world.bubbles is not None:
            parts |= self._bubbles(world.bubbles, refractive_index(world.rig))
        for name, mesh in (needle or {}).items():
            parts[name] = self._mesh(name, mesh, self._metal(world, name))
        # Optimisation may change the order of shapes, and with it the noise.
        self.tracer = self._mi.load_dict(parts, optimize=False)
        self._parameters = self._mi.traverse(self.tracer)

    def update_needle(self, needle: dict[str, Mesh]) -> None:
        """Update the shape of the needle."""
        for name, mesh in needle.items():
            self._set(self._parameters, f"{name}.", mesh)
        self._parameters.update()

    def _set(self, parameters: Any, prefix: str, mesh: Mesh) -> None:
        flat = self._mi.Float
        parameters[prefix + "vertex_positions"] = flat((MM * mesh.points).astype("f4").ravel())
        parameters[prefix + "vertex_normals"] = flat(mesh.normals.astype("f4").ravel())

    def _mesh(self, name: str, mesh: Mesh, material: dict[str, Any]) -> Any:
        mi = self._mi
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict(material)
        shape = mi.Mesh(
            name,
            len(mesh.points),
            len(mesh.faces),
            has_vertex_normals=True,
            has_vertex_texcoords=True,
            props=properties,
        )
        parameters = mi.traverse(shape)
        self._set(parameters, "", mesh)
        parameters["faces"] = mi.UInt32(mesh.faces.ravel())
        parameters["vertex_texcoords"] = mi.Float(mesh.texture.astype("f4").ravel())
        parameters.update()
        return shape

    def _metal(self, world: World, part: str) -> dict[str, Any]:
        appearance, index = world.appearance, refractive_index(world.rig)
        if part == "bore":
            return _both_sides({"type": "diffuse", "reflectance": 0.03})
        along, across = appearance.roughness_along, appearance.roughness_across
        if part == "face":
            along = across = appearance.face_roughness
        # Grinding removes paint and oxide.
        dark = None if part == "face" else _DARK.get(appearance.metal)
        if dark is None:
            return _both_sides(
                {
                    "type": "roughconductor",
                    "distribution": "ggx",
                    "eta": _STEEL_INDEX / index,
                    "k": _STEEL_EXTINCTION / index,
                    "alpha_u": along,
                    "alpha_v": across,
                }
            )
        return _both_sides(
            {
                "type": "roughplastic",
                "distribution": "ggx",
                "int_ior": _PAINT_INDEX,
                "ext_ior": index,
                "diffuse_reflectance": dark,
                "alpha": along,
            }
        )

    def _floor(self, world: World, behind: Backdrop) -> dict[str, Any]:
        half_z = (floors.END - floors.BEGIN) / 2.0
        middle = behind.points(np.array(0.0), np.array(floors.BEGIN + half_z))
        transform = self._transform().look_at(
            origin=_mm(middle), target=_mm(middle + behind.normal), up=behind.sideways.tolist()
        )
        shape: dict[str, Any] = {
            "type": "rectangle",
            "to_world": transform @ self._transform().scale([MM * half_z, MM * floors.SIDE, 1.0]),
        }
        picture = behind.picture[::_COARSER, ::_COARSER, np.newaxis]
        if world.appearance.floor == "panel":
            shape["emitter"] = {"type": "area", "radiance": PANEL_RADIANCE}
            picture = np.full_like(picture, ALBEDO["panel"])
        shape["bsdf"] = {
            "type": "diffuse",
            "reflectance": {
                "type": "bitmap",
                # The first axis of the rectangle is -z.
                "bitmap": self._mi.Bitmap(np.ascontiguousarray(picture[:, ::-1])),
                "raw": True,
                "wrap_mode": "clamp",
            },
        }
        return shape

    def _box(self, world: World) -> dict[str, Any]:
        """Return the walls of the box, and the sheath in front of it."""
        (bottom, top), (_, beside) = block_bounds(world.rig, world.appearance)
        wall = world.wall
        # Centres and half sides: front (where the needle enters), far end, and both opaque sides.
        high = (top - bottom) / 2.0
        middle = (top + bottom) / 2.0 - 1e-5
        long = (LENGTH + 2.0 * wall) / 2.0
        walls = {
            "front": ([middle, 0.0, -wall / 2.0], [high, beside, wall / 2.0]),
            "end": ([middle, 0.0, LENGTH + wall / 2.0], [high, beside, wall / 2.0]),
        }
        if not is_box(world.rig):
            walls |= {
                name: ([middle, y, long - wall], [high, wall / 2.0, long])
                for name, y in (("left", -beside - wall / 2.0), ("right", beside + wall / 2.0))
            }
        material = self._mi.load_dict({"type": "diffuse", "reflectance": world.wall_albedo})
        parts = {
            name: {
                "type": "cube",
                "to_world": self._transform().translate(_mm(centre)).scale(_mm(half)),
                "bsdf": material,
            }
            for name, (centre, half) in walls.items()
        }
        parts["sheath"] = {
            "type": "cylinder",
            "p0": _mm([0.0, 0.0, -_SHEATH_LENGTH - wall]),
            "p1": _mm([0.0, 0.0, -wall]),
            "radius": MM * _SHEATH_RADIUS,
            "bsdf": _both_sides({"type": "roughconductor", "alpha": 0.2}),
        }
        return parts

    def _light(self, world: World) -> dict[str, Any]:
        parts: dict[str, Any] = {}
        for number, lamp in enumerate(world.lamps):
            centre = apparent_centre(lamp, world.rig)
            transform = self._transform().look_at(
                origin=_mm(centre), target=_mm(MIDDLE), up=[0.0, 0.0, 1.0]
            )
            across, along = lamp.half_sides[::-1] if lamp.turned else lamp.half_sides
            parts[f"lamp_{number}"] = {
                "type": "rectangle",
                "to_world": transform @ self._transform().scale([MM * across, MM * along, 1.0]),
                "emitter": {"type": "area", "radiance": lamp.radiance},
            }
        # Rotate the picture's up direction from y to x.
        parts["room"] = {
            "type": "envmap",
            "bitmap": self._mi.Bitmap(room_light(world)[..., np.newaxis]),
            "to_world": self._transform().rotate([0.0, 0.0, 1.0], -90.0),
        }
        return parts

    def _bubbles(self, cloud: BubbleCloud, index: float) -> dict[str, Any]:
        air = self._mi.load_dict({"type": "dielectric", "int_ior": 1.0, "ext_ior": index})
        return {
            f"bubble_{number}": {
                "type": "sphere",
                "center": _mm(centre),
                "radius": MM * float(radius),
                "bsdf": air,
            }
            for number, (centre, radius) in enumerate(zip(cloud.centre, cloud.radius, strict=True))
        }

    def _transform(self) -> Any:
        return self._mi.ScalarTransform4f()


def _both_sides(material: dict[str, Any]) -> dict[str, Any]:
    return {"type": "twosided", "material": material}


def _mm(point: Any) -> list[float]:
    return [MM * float(part) for part in point]
