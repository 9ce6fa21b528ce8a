"""Appearance of a sequence: metal, light, floor and dirt, random or by name."""

from __future__ import annotations

import dataclasses
from typing import Literal, get_args

import numpy as np

from needle_core.errors import UserError

Metal = Literal["polished", "drawn", "oxide", "painted"]
Lamps = Literal["softbox", "softboxes", "strip", "room"]
Floor = Literal["grey", "dark", "light", "graph", "brushed", "cloth", "print", "panel", "clutter"]

METALS: tuple[Metal, ...] = get_args(Metal)
LAMPS: tuple[Lamps, ...] = get_args(Lamps)
FLOORS: tuple[Floor, ...] = get_args(Floor)

_STREAM = 20
_PLAIN_DIAMETER = 0.0007
# Mean reflectance, and range of the grey level under full light, by kind of floor.
_FLOORS: dict[Floor, tuple[float, float, float]] = {
    "grey": (0.35, 95.0, 165.0),
    "dark": (0.05, 22.0, 60.0),
    "light": (0.75, 150.0, 195.0),
    "graph": (0.75, 105.0, 190.0),
    "brushed": (0.45, 80.0, 170.0),
    "cloth": (0.35, 60.0, 165.0),
    "print": (0.75, 110.0, 195.0),
    "panel": (0.6, 140.0, 215.0),
    "clutter": (0.4, 50.0, 150.0),
}
ALBEDO = {floor: albedo for floor, (albedo, *_) in _FLOORS.items()}
"""Mean reflectance by kind of floor."""
# Roughness (GGX alpha) along the shaft, across it and of the ground face, by metal.
_ROUGHNESS: dict[Metal, tuple[tuple[float, float], ...]] = {
    "polished": ((0.05, 0.15), (0.05, 0.15), (0.05, 0.2)),
    "drawn": ((0.2, 0.4), (0.1, 0.3), (0.05, 0.3)),
    "oxide": ((0.2, 0.45), (0.2, 0.45), (0.1, 0.4)),
    "painted": ((0.06, 0.3), (0.06, 0.3), (0.1, 0.35)),
}


@dataclasses.dataclass(frozen=True)
class Appearance:
    """Appearance of a sequence; positions follow from `seed`.

    Attributes
    ----------
    name : str
        Name in `APPEARANCES`.
    seed : int
        Seed of lamp positions, texture, bubbles, lint and noise.
    needle : bool
        Whether the images show a needle.
    metal : str
        Surface of the shaft: one of `METALS`; never dark on a dark floor.
    roughness_along, roughness_across, face_roughness : float
        GGX alpha of the shaft, along and across, 0.05 to 0.45, and of the bevel, 0.05 to 0.4.
    diameter : float
        Diameter of the shaft: 0.7 mm in 60 % of the draws, else 0.5 to 1.3 mm [m].
    bevel_angle : float
        Angle between bevel and axis, 18 to 45 deg [rad].
    hollow : bool
        Whether the needle is hollow.
    lean : float
        Angle between the pre-bent last 9 mm and the heading, 0 or 2 to 6 deg [rad].
    lamps : str
        One of `LAMPS`.
    room_light : float
        Light of the room relative to the lamps, 0.04 to 0.6.
    floor : str
        One of `FLOORS`: under the phantom, or one behind a clear box for each camera.
    floor_height : float
        x of the floor in `rig`, -35 to -18 mm [m].
    behind : float
        Distance of the background behind a clear box, 5 to 120 mm [m].
    floor_level : float
        Median of the image without needle [grey levels].
    floor_blur_px : float
        Additional blur of the floor, 0 to 2.5 px [px].
    bubbles, lint, tracks : int
        Numbers: 0 to 90, 0 to 25, 0 to 4 (paths of earlier needles).
    track_strength : float
        Contrast of the strongest path of an earlier needle, 0.03 to 0.35.
    haze : float
        Share of the light that the phantom scatters, 0 to 0.35.
    blur_px : float
        Standard deviation of the lens's blur at the needle, 0.3 to 1.1 px [px].
    bloom : float
        Share of the light above full scale that spreads to neighbours, 0 to 0.05.
    noise : float
        Standard deviation of the sensor noise in the dark, 0.4 to 4 [grey levels].
    shot_noise : float
        Standard deviation of the shot noise at full scale, 0.5 to 5 [grey levels].
    flicker : float
        Standard deviation of the exposure from pair to pair, 0 to 0.03.
    lag : float
        Insertion between the exposures of left and right, 0 to 0.2 mm [m].
    """

    name: str
    seed: int
    needle: bool
    metal: Metal
    roughness_along: float
    roughness_across: float
    face_roughness: float
    diameter: float
    bevel_angle: float
    hollow: bool
    lean: float
    lamps: Lamps
    room_light: float
    floor: Floor
    floor_height: float
    behind: float
    floor_level: float
    floor_blur_px: float
    bubbles: int
    lint: int
    tracks: int
    track_strength: float
    haze: float
    blur_px: float
    bloom: float
    noise: float
    shot_noise: float
    flicker: float
    lag: float

    @property
    def bevel_length(self) -> float:
        """Length of the bevel along the needle's axis [m]."""
        return float(self.diameter / np.tan(self.bevel_angle))


@dataclasses.dataclass(frozen=True)
class NamedAppearance:
    """Named appearance with some fixed properties; the others are drawn.

    Attributes
    ----------
    summary : str
        Description for the user.
    metal, lamps, floor : str or None
        Fixed value; None: drawn at random.
    needle : bool
        Whether the images show a needle.
    """

    summary: str
    metal: Metal | None = None
    lamps: Lamps | None = None
    floor: Floor | None = None
    needle: bool = True


RANDOM = "random"

APPEARANCES = {
    RANDOM: NamedAppearance("all properties drawn from the seed"),
    "drawn_on_grey": NamedAppearance(
        "drawn steel under two softboxes", "drawn", "softboxes", "grey"
    ),
    "drawn_on_dark": NamedAppearance(
        "drawn steel under two softboxes", "drawn", "softboxes", "dark"
    ),
    "drawn_on_light": NamedAppearance("drawn steel under a softbox", "drawn", "softbox", "light"),
    "drawn_on_graph_paper": NamedAppearance("drawn steel under a strip", "drawn", "strip", "graph"),
    "drawn_on_brushed": NamedAppearance(
        "drawn steel over brushed metal", "drawn", "softbox", "brushed"
    ),
    "polished_over_cloth": NamedAppearance(
        "polished steel over cloth", "polished", "softboxes", "cloth"
    ),
    "polished_in_a_room": NamedAppearance(
        "polished steel in even light", "polished", "room", "grey"
    ),
    "oxide_on_grey": NamedAppearance(
        "dark oxide under two softboxes", "oxide", "softboxes", "grey"
    ),
    "oxide_over_lit_panel": NamedAppearance(
        "dark oxide against a lit panel", "oxide", "softbox", "panel"
    ),
    "painted_on_print": NamedAppearance(
        "black paint over printed paper", "painted", "softbox", "print"
    ),
    "drawn_before_clutter": NamedAppearance(
        "drawn steel, screws and cables behind", "drawn", None, "clutter"
    ),
    "absent": NamedAppearance(
        "no needle: bubbles, lint, print; all drawn from the seed", needle=False
    ),
}
"""Fixed properties by name."""


def draw_appearance(name: str, seed: int) -> Appearance:
    """Return a random appearance with the fixed properties of a name.

    Parameters
    ----------
    name : str
        A key of `APPEARANCES`.
    seed : int
        Seed, not negative.

    Raises
    ------
    UserError
        If the name is unknown.
    """
    fixed = APPEARANCES.get(name)
    if fixed is None:
        raise UserError(f"appearance {name!r} is not one of {', '.join(APPEARANCES)}")
    rng = np.random.default_rng([seed, 0, _STREAM])

    def between(lower: float, upper: float) -> float:
        return float(rng.uniform(lower, upper))

    def sometimes(share: float, lower: float, upper: float) -> float:
        """Return a number between the bounds with probability `share`, else 0."""
        value = between(lower, upper)
        return value if rng.random() < share else 0.0

    metal = METALS[rng.choice(len(METALS), p=[0.3, 0.35, 0.2, 0.15])]
    lamps = LAMPS[rng.choice(len(LAMPS), p=[0.25, 0.4, 0.2, 0.15])]
    floor = FLOORS[rng.integers(len(FLOORS))]
    lamps, floor = fixed.lamps or lamps, fixed.floor or floor
    if floor == "dark" and metal in ("oxide", "painted"):
        # A dark needle on a dark floor is invisible.
        metal = "drawn"
    metal = fixed.metal or metal
    along, across, face = (between(*bounds) for bounds in _ROUGHNESS[metal])
    return Appearance(
        name=name,
        seed=seed,
        needle=fixed.needle,
        metal=metal,
        roughness_along=along,
        roughness_across=across,
        face_roughness=face,
        diameter=sometimes(0.4, 0.0005, 0.0013) or _PLAIN_DIAMETER,
        bevel_angle=float(np.deg2rad(between(18.0, 45.0))),
        hollow=bool(rng.random() < 0.35),
        lean=float(np.deg2rad(sometimes(0.4, 2.0, 6.0))),
        lamps=lamps,
        room_light=between(0.2, 1.0) ** 2 * 0.6,
        floor=floor,
        floor_height=between(-0.035, -0.018),
        floor_level=between(*_FLOORS[floor][1:]),
        floor_blur_px=sometimes(0.7, 0.2, 2.5),
        bubbles=round(sometimes(0.8, 3.0, 90.0)),
        lint=round(sometimes(0.7, 1.0, 25.0)),
        tracks=round(sometimes(0.5, 0.51, 4.49)),
        haze=sometimes(0.4, 0.05, 0.35),
        blur_px=between(0.3, 1.1),
        bloom=sometimes(0.6, 0.005, 0.05),
        noise=between(0.4, 4.0),
        shot_noise=between(0.5, 5.0),
        flicker=sometimes(0.6, 0.003, 0.03),
        lag=sometimes(0.3, 0.00002, 0.0002),
        behind=between(0.005, 0.12),
        track_strength=between(0.03, 0.35),
    )
