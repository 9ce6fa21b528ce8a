"""Static parts of a path-traced sequence: block, backdrops, lamps, room light and bubbles."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from needle_sim.camera.clutter import BubbleCloud, place_bubbles
from needle_sim.camera.optics import FloatImage, refraction_point
from needle_sim.camera.scenarios import Bubbles
from needle_sim.camera.stereo_rig import SimulatedCamera, SimulatedWindow, StereoRig
from needle_sim.needle.se3 import FloatArray
from needle_sim.path_traced import floors
from needle_sim.path_traced.appearance import ALBEDO, Appearance, Lamps

LENGTH = 0.155
"""Length of the block along z, from the needle's entry [m]."""
_SIDE = 0.07  # half width of a block under a common level surface [m]


def refractive_index(rig: StereoRig) -> float:
    """Return the refractive index of the phantom [-]."""
    return rig.left.window.indices[-1]


def is_box(rig: StereoRig) -> bool:
    """Return whether each camera has its own clear wall; otherwise both share one surface."""
    return float(rig.left.window.normal @ rig.right.window.normal) < 0.5


def reach_sideways(camera: SimulatedCamera, rig: StereoRig) -> float:
    """Return the half width of a camera's wall [m], infinite if the surface is shared."""
    other = rig.right if camera is rig.left else rig.left
    return other.window.inner if is_box(rig) else np.inf


def block_bounds(
    rig: StereoRig, appearance: Appearance
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the bounds of the block in x and y [m]."""
    if is_box(rig):
        return (-rig.half_height, rig.half_height), (-rig.half_width, rig.half_width)
    return (appearance.floor_height, rig.half_height), (-_SIDE, _SIDE)


@dataclasses.dataclass(frozen=True, eq=False)
class Backdrop:
    """Plane with a picture behind the needle, parallel to z and facing a camera's window.

    Objects in the air behind a clear box are placed as if the gel extended to them.

    Attributes
    ----------
    normal, sideways : ndarray, shape (3,)
        Unit vectors in `rig`, towards the camera and across the needle; both across z.
    depth : float
        Distance of the plane behind the needle's axis [m].
    gel : float
        Path length through the phantom, from the window's inner face [m].
    picture : ndarray of float32, shape (rows, columns)
        Reflectance of the plane, see `floors`.
    """

    normal: FloatArray
    sideways: FloatArray
    depth: float
    gel: float
    picture: FloatImage

    def points(self, aside: FloatArray, along: FloatArray) -> FloatArray:
        """Return points on the plane, (..., 3) in `rig`, from lateral and z coordinates [m]."""
        return np.asarray(
            np.asarray(aside)[..., np.newaxis] * self.sideways
            + np.asarray(along)[..., np.newaxis] * [0.0, 0.0, 1.0]
            - self.depth * self.normal
        )

    def intersect(self, origin: FloatArray, direction: FloatArray) -> FloatArray:
        """Return the intersections of rays with the plane, (..., 3) in `rig` [m]."""
        length = -(self.depth + origin @ self.normal) / (direction @ self.normal)
        return np.asarray(origin + length[..., np.newaxis] * direction)

    def reflectance(self, points: FloatArray) -> FloatImage:
        """Return the reflectance at points of the plane, (rows, columns, 3) in `rig` [m]."""
        column = ((points[..., 2] - floors.BEGIN) / floors.SPACING - 0.5).astype(np.float32)
        row = ((points @ self.sideways + floors.SIDE) / floors.SPACING - 0.5).astype(np.float32)
        sampled = cv2.remap(
            self.picture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
        )
        return np.asarray(sampled, dtype=np.float32)


def backdrop(
    camera: SimulatedCamera, rig: StereoRig, appearance: Appearance, picture: FloatImage
) -> Backdrop:
    """Return the backdrop of a camera: the floor, or the background behind the box."""
    window = camera.window
    normal = np.array([*window.normal[:2], 0.0])
    depth = window.inner + appearance.behind if is_box(rig) else -appearance.floor_height
    gel = 2.0 * window.inner if is_box(rig) else window.inner + depth
    return Backdrop(normal / np.linalg.norm(normal), window.sideways, depth, gel, picture)


MIDDLE = np.array([0.0, 0.0, 0.06])
"""Centre of the visible phantom in `rig`, at which lamps point [m]."""

# Angles from the vertical over MIDDLE: across the needle (either side), along it; distance [m].
_ACROSS = np.deg2rad([8.0, 60.0])
_ALONG = np.deg2rad(25.0)
_DISTANCES = (0.35, 0.75)
_SOFTBOX = (0.05, 0.2)
_STRIP_WIDTH = (0.008, 0.025)
_STRIP_LENGTH = (0.15, 0.35)


@dataclasses.dataclass(frozen=True, eq=False)
class Lamp:
    """Bright rectangle that points at the centre of the phantom.

    Attributes
    ----------
    centre : ndarray, shape (3,)
        Centre in `rig`, in air [m].
    half_sides : pair of float
        Half sides; the second is roughly parallel to the needle, unless `turned` [m].
    turned : bool
        Whether the sides are exchanged.
    radiance : float
        Radiance relative to the brightest lamp.
    """

    centre: FloatArray
    half_sides: tuple[float, float]
    turned: bool
    radiance: float


def place_lamps(kind: Lamps, rng: np.random.Generator) -> list[Lamp]:
    """Return the lamps of a kind at random positions, alternating between both sides."""
    count = {"softbox": 1, "softboxes": 2, "strip": 1, "room": 0}[kind]
    side = rng.choice([-1.0, 1.0])
    lamps = []
    for number in range(count):
        across = side * (-1.0) ** number * rng.uniform(*_ACROSS)
        along = rng.normal(0.0, _ALONG)
        direction = np.array([1.0, np.tan(across), np.tan(np.clip(along, -1.0, 1.0))])
        direction /= np.linalg.norm(direction)
        centre = MIDDLE + rng.uniform(*_DISTANCES) * direction
        # A lower lamp would be hidden by the phantom's top.
        centre[0] = max(centre[0], 0.15)
        sizes = (_STRIP_WIDTH, _STRIP_LENGTH) if kind == "strip" else (_SOFTBOX, _SOFTBOX)
        half = (float(rng.uniform(*sizes[0])), float(rng.uniform(*sizes[1])))
        radiance = 1.0 if number == 0 else float(rng.uniform(0.25, 1.0))
        lamps.append(Lamp(centre, half, bool(rng.random() < 0.3), radiance))
    return lamps


def apparent_centre(lamp: Lamp, rig: StereoRig) -> FloatArray:
    """Return the apparent position of a lamp from the centre of the phantom, (3,) in `rig` [m].

    It keeps its horizontal position and appears higher, because refraction makes the light steeper
    inside. The top is level and without layers, regardless of the cameras' windows.
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
    """Return the approximate irradiance of the floor at its centre, in units of the radiance."""
    total = 0.0
    for lamp in lamps:
        away = apparent_centre(lamp, rig) - MIDDLE
        square = float(away @ away)
        area = 4.0 * lamp.half_sides[0] * lamp.half_sides[1]
        total += lamp.radiance * area * float(away[0]) / square**1.5
    return total


PANEL_RADIANCE = 1.0
"""Radiance of a lit panel, in units of the brightest lamp."""

_STREAM = 30
_ROOM_STREAM = 31
_SMALLEST_BUBBLE = 0.0001
_LARGEST_BUBBLES = (0.0003, 0.0012)
_BOX_WALLS = (0.003, 0.008)
_WALL_ALBEDOS = (0.05, 0.8)
# Pixels of the room's light: polar and azimuthal.
_SKY = (64, 32)


@dataclasses.dataclass(frozen=True, eq=False)
class World:
    """Static parts of a sequence.

    Attributes
    ----------
    rig : StereoRig
        Phantom and cameras.
    appearance : Appearance
        Appearance of the sequence.
    lamps : list of Lamp
        Lamps.
    room : float
        Radiance of the room relative to the brightest lamp.
    backdrops : pair of Backdrop
        Backdrops of left and right; identical if both share a surface.
    bubbles : BubbleCloud or None
        Bubbles in the phantom.
    wall : float
        Thickness of the box's walls [m].
    wall_albedo : float
        Reflectance of the walls.
    """

    rig: StereoRig
    appearance: Appearance
    lamps: list[Lamp]
    room: float
    backdrops: tuple[Backdrop, Backdrop]
    bubbles: BubbleCloud | None
    wall: float
    wall_albedo: float


def make_world(rig: StereoRig, appearance: Appearance) -> World:
    """Return the static parts of a sequence, determined by its appearance."""
    rng = np.random.default_rng([appearance.seed, 0, _STREAM])
    lamps = place_lamps(appearance.lamps, rng)
    wall, albedo = float(rng.uniform(*_BOX_WALLS)), float(rng.uniform(*_WALL_ALBEDOS))
    bubbles = None
    if appearance.bubbles > 0:
        kinds = Bubbles(appearance.bubbles, _SMALLEST_BUBBLE, float(rng.uniform(*_LARGEST_BUBBLES)))
        bubbles = place_bubbles(kinds, rig, rng)
    room = appearance.room_light * irradiance(lamps, rig) / np.pi if lamps else 1.0
    left = backdrop(rig.left, rig, appearance, floors.floor_picture(appearance.floor, rng))
    right = left
    if is_box(rig):
        right = backdrop(rig.right, rig, appearance, floors.floor_picture(appearance.floor, rng))
    return World(rig, appearance, lamps, room, (left, right), bubbles, wall, albedo)


def room_light(world: World) -> FloatImage:
    """Return the radiance of the room by direction, seen from inside the phantom.

    Rows are polar angles from up to down, columns azimuths. Within the critical angle the room is
    visible; beyond it, the surface mirrors the inside of the phantom, mostly its floor. A clear box
    is open to all sides.
    """
    appearance = world.appearance
    rng = np.random.default_rng([appearance.seed, 0, _ROOM_STREAM])
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
    mirrored = ALBEDO[appearance.floor] * light
    if appearance.floor == "panel":
        mirrored += PANEL_RADIANCE
    total = np.sin(polar) > 1.0 / refractive_index(world.rig)
    sky[total] = mirrored
    return np.asarray(np.maximum(sky, 0.0), dtype=np.float32)
