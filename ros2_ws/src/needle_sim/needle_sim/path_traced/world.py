"""Still parts of a sequence: lamps, room, floor, bubbles and box, placed by the seed."""

from __future__ import annotations

import dataclasses

import numpy as np

from needle_sim.camera.bubbles import BubbleCloud, place_bubbles
from needle_sim.camera.optics import FloatImage
from needle_sim.camera.scenarios import Bubbles
from needle_sim.camera.stereo_rig import StereoRig
from needle_sim.path_traced.appearance import Appearance
from needle_sim.path_traced.block import Backdrop, backdrop, is_box, refractive_index
from needle_sim.path_traced.floors import ALBEDO, floor_picture
from needle_sim.path_traced.lamps import Lamp, irradiance, place_lamps

PANEL_RADIANCE = 1.0
"""Of a lit panel, as of the brightest lamp."""

_STREAM = 30
_ROOM_STREAM = 31
_SMALLEST_BUBBLE = 0.0001
_LARGEST_BUBBLES = (0.0003, 0.0012)
_BOX_WALLS = (0.003, 0.008)
_WALL_ALBEDOS = (0.05, 0.8)
# Pixels of the room's light: from up to down, and around.
_SKY = (64, 32)


@dataclasses.dataclass(frozen=True, eq=False)
class World:
    """Still parts of a sequence.

    Attributes
    ----------
    rig : StereoRig
        Phantom and cameras.
    look : Appearance
        Kinds and amounts.
    lamps : list of Lamp
        Where the light comes from.
    room : float
        Radiance of the room, against the brightest lamp's.
    backdrops : pair of Backdrop
        What left and right see behind the needle; the same one where they share a surface.
    bubbles : BubbleCloud or None
        Air in the phantom.
    wall : float
        Thickness of the box's walls [m].
    wall_albedo : float
        Share of the light that they give back.
    """

    rig: StereoRig
    look: Appearance
    lamps: list[Lamp]
    room: float
    backdrops: tuple[Backdrop, Backdrop]
    bubbles: BubbleCloud | None
    wall: float
    wall_albedo: float


def make_world(rig: StereoRig, look: Appearance) -> World:
    """Return what stands still in a sequence of a look; the same look gives the same."""
    rng = np.random.default_rng([look.seed, 0, _STREAM])
    lamps = place_lamps(look.lamps, rng)
    wall, albedo = float(rng.uniform(*_BOX_WALLS)), float(rng.uniform(*_WALL_ALBEDOS))
    bubbles = None
    if look.bubbles > 0:
        kinds = Bubbles(look.bubbles, _SMALLEST_BUBBLE, float(rng.uniform(*_LARGEST_BUBBLES)))
        bubbles = place_bubbles(kinds, rig, rng)
    room = look.room_light * irradiance(lamps, rig) / np.pi if lamps else 1.0
    left = backdrop(rig.left, rig, look, floor_picture(look.floor, rng))
    right = left
    if is_box(rig):
        right = backdrop(rig.right, rig, look, floor_picture(look.floor, rng))
    return World(rig, look, lamps, room, (left, right), bubbles, wall, albedo)


def room_light(world: World) -> FloatImage:
    """Return the room's radiance by direction, as one inside the phantom sees it.

    Rows lead from straight up to straight down, columns around. Above the critical angle there is
    the room; below it the surface mirrors what is in the phantom: mostly its floor. A clear box is
    open to all sides.
    """
    look = world.look
    rng = np.random.default_rng([look.seed, 0, _ROOM_STREAM])
    rows, columns = _SKY
    polar = (np.arange(rows) + 0.5) / rows * np.pi
    around = (np.arange(columns) + 0.5) / columns * 2.0 * np.pi
    phase, strength = rng.uniform(0.0, 2.0 * np.pi, 3), rng.uniform(0.0, 0.5)
    waves = sum(
        np.cos((turns + 1) * around + shift) / (turns + 1) for turns, shift in enumerate(phase)
    )
    sky = world.room * (1.0 + strength * np.sin(polar)[:, np.newaxis] * waves / 1.9)
    if is_box(world.rig):
        return np.asarray(np.maximum(sky, 0.0), dtype=np.float32)
    light = irradiance(world.lamps, world.rig) / np.pi + world.room
    mirrored = ALBEDO[look.floor] * light
    if look.floor == "panel":
        mirrored += PANEL_RADIANCE
    total = np.sin(polar) > 1.0 / refractive_index(world.rig)
    sky[total] = mirrored
    return np.asarray(np.maximum(sky, 0.0), dtype=np.float32)
