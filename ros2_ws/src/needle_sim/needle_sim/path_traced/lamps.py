"""Lamps over the phantom: where they stand, and where one inside the phantom sees them."""

from __future__ import annotations

import dataclasses

import numpy as np

from needle_sim.camera.projection import refraction_point
from needle_sim.camera.stereo_rig import StereoRig
from needle_sim.camera.window import SimulatedWindow
from needle_sim.needle.se3 import FloatArray
from needle_sim.path_traced.appearance import Lamps
from needle_sim.path_traced.block import refractive_index

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
