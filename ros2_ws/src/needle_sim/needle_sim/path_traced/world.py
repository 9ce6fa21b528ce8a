"""Static parts of a path-traced sequence: block, backdrops, lamps, room light and bubbles."""

from __future__ import annotations

import dataclasses

import numpy as np

from needle_sim.camera.clutter import BubbleCloud, place_bubbles
from needle_sim.camera.optics import FloatImage, refraction_point
from needle_sim.camera.scenarios import Bubbles
from needle_sim.camera.stereo_rig import SimulatedCamera, SimulatedWindow, StereoRig
from needle_sim.needle.se3 import FloatArray
from needle_sim.path_traced.appearance import Appearance, Lamps
from needle_sim.path_traced.floors import ALBEDO, FloorPicture, floor_picture

LENGTH = 0.155
"""Of the block along z, from the needle's entry on [m]."""
_SIDE = 0.07  # of a block under one level surface [m]


def refractive_index(rig: StereoRig) -> float:
    """Return the phantom's refractive index [-]."""
    return rig.left.window.indices[-1]


def is_box(rig: StereoRig) -> bool:
    """Return whether each camera has a wall of its own, all clear; else both share one surface."""
    return float(rig.left.window.normal @ rig.right.window.normal) < 0.5


def reach_sideways(camera: SimulatedCamera, rig: StereoRig) -> float:
    """Return how far a camera's wall reaches to both sides; a shared surface is endless [m]."""
    other = rig.right if camera is rig.left else rig.left
    return other.window.inner if is_box(rig) else np.inf


def sides(rig: StereoRig, look: Appearance) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the block's bounds in x and y [m]."""
    if is_box(rig):
        return (-rig.half_height, rig.half_height), (-rig.half_width, rig.half_width)
    return (look.floor_height, rig.half_height), (-_SIDE, _SIDE)


@dataclasses.dataclass(frozen=True, eq=False)
class Backdrop:
    """A plane with a picture behind the needle, upright before a camera's window.

    What stands in the air behind a clear box is put where it would be if the gel went on.

    Attributes
    ----------
    normal, sideways : ndarray, shape (3,)
        Unit vectors in `rig`, towards the camera and across the needle; both across z.
    depth : float
        Of the plane behind the needle's axis [m].
    gel : float
        Way through the phantom towards it, from the window's inner face [m].
    picture : FloorPicture
        How much light each place gives back.
    """

    normal: FloatArray
    sideways: FloatArray
    depth: float
    gel: float
    picture: FloorPicture

    def points(self, aside: FloatArray, along: FloatArray) -> FloatArray:
        """Return places on the plane, (..., 3) in `rig`, by y-like and z coordinate [m]."""
        return np.asarray(
            np.asarray(aside)[..., np.newaxis] * self.sideways
            + np.asarray(along)[..., np.newaxis] * [0.0, 0.0, 1.0]
            - self.depth * self.normal
        )

    def intersect(self, origin: FloatArray, direction: FloatArray) -> FloatArray:
        """Return where rays, each (..., 3), meet the plane, (..., 3) in `rig` [m]."""
        length = -(self.depth + origin @ self.normal) / (direction @ self.normal)
        return np.asarray(origin + length[..., np.newaxis] * direction)

    def reflectance(self, points: FloatArray) -> FloatImage:
        """Return the picture at places of the plane, (rows, columns, 3) in `rig` [m]."""
        return self.picture.at(points @ self.sideways, points[..., 2])


def backdrop(
    camera: SimulatedCamera, rig: StereoRig, look: Appearance, picture: FloorPicture
) -> Backdrop:
    """Return what a camera sees behind the needle: the floor, or what stands behind the box."""
    window = camera.window
    normal = np.array([*window.normal[:2], 0.0])
    depth = window.inner + look.behind if is_box(rig) else -look.floor_height
    gel = 2.0 * window.inner if is_box(rig) else window.inner + depth
    return Backdrop(normal / np.linalg.norm(normal), window.sideways, depth, gel, picture)


MIDDLE = np.array([0.0, 0.0, 0.06])
"""Of what the cameras see of the phantom, in `rig` [m]: lamps point there."""

# Angles from the vertical over MIDDLE: across the needle (either side), along it; distance [m].
_ACROSS = np.deg2rad([8.0, 60.0])
_ALONG = np.deg2rad(25.0)
_DISTANCES = (0.35, 0.75)
_SOFTBOX = (0.05, 0.2)
_STRIP_WIDTH = (0.008, 0.025)
_STRIP_LENGTH = (0.15, 0.35)


@dataclasses.dataclass(frozen=True, eq=False)
class Lamp:
    """A bright rectangle that points at the phantom's middle.

    Attributes
    ----------
    centre : ndarray, shape (3,)
        In `rig`, in air [m].
    half_sides : pair of float
        Half its sides; the second lies about along the needle, unless it is turned [m].
    turned : bool
        Whether the sides are exchanged.
    radiance : float
        Against that of the brightest lamp.
    """

    centre: FloatArray
    half_sides: tuple[float, float]
    turned: bool
    radiance: float


def place_lamps(kind: Lamps, rng: np.random.Generator) -> list[Lamp]:
    """Return the lamps of a kind in random places: one side first, the second on the other."""
    count = {"softbox": 1, "softboxes": 2, "strip": 1, "room": 0}[kind]
    side = rng.choice([-1.0, 1.0])
    lamps = []
    for number in range(count):
        across = side * (-1.0) ** number * rng.uniform(*_ACROSS)
        along = rng.normal(0.0, _ALONG)
        direction = np.array([1.0, np.tan(across), np.tan(np.clip(along, -1.0, 1.0))])
        direction /= np.linalg.norm(direction)
        centre = MIDDLE + rng.uniform(*_DISTANCES) * direction
        # No lamp beside the phantom: its top would hide it.
        centre[0] = max(centre[0], 0.15)
        sizes = (_STRIP_WIDTH, _STRIP_LENGTH) if kind == "strip" else (_SOFTBOX, _SOFTBOX)
        half = (float(rng.uniform(*sizes[0])), float(rng.uniform(*sizes[1])))
        radiance = 1.0 if number == 0 else float(rng.uniform(0.25, 1.0))
        lamps.append(Lamp(centre, half, bool(rng.random() < 0.3), radiance))
    return lamps


def apparent_centre(lamp: Lamp, rig: StereoRig) -> FloatArray:
    """Return where a lamp seems to stand from the middle of the phantom, (3,) in `rig` [m].

    It is seen straight above its place on the ground, as much higher as Snell's law makes the light
    steeper inside: through a level top without layers, whatever the cameras look through.
    """
    up, index = np.array([1.0, 0.0, 0.0]), refractive_index(rig)
    top = SimulatedWindow(up, rig.half_height, (), (index,))
    crossing = refraction_point(MIDDLE, lamp.centre, top)
    inside = crossing - MIDDLE
    aside = lamp.centre[1:] - MIDDLE[1:]
    bent = float(np.linalg.norm(inside[1:]))
    height = index * lamp.centre[0]
    if bent > 1e-6:
        height = inside[0] / bent * float(np.linalg.norm(aside))
    return np.array([height, *lamp.centre[1:]])


def irradiance(lamps: list[Lamp], rig: StereoRig) -> float:
    """Return about how much light falls on a floor at the middle, of the radiance's unit."""
    total = 0.0
    for lamp in lamps:
        away = apparent_centre(lamp, rig) - MIDDLE
        square = float(away @ away)
        area = 4.0 * lamp.half_sides[0] * lamp.half_sides[1]
        total += lamp.radiance * area * float(away[0]) / square**1.5
    return total


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
