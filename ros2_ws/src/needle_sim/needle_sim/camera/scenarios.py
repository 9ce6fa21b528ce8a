"""Scenarios: named disturbances of the simulated images, from clean to blocked cameras.

A scenario is data; positions and times follow from it, the seed and the number of the exposure.
"""

from __future__ import annotations

import dataclasses

from needle_core.errors import UserError
from needle_core.settings.bounds import check_bounds


@dataclasses.dataclass(frozen=True)
class Bubbles:
    """Air bubbles cast into the phantom.

    Attributes
    ----------
    count : int
        Number of bubbles.
    smallest, largest : float
        Bounds of the radii; small bubbles are more frequent [m].
    """

    count: int
    smallest: float
    largest: float


@dataclasses.dataclass(frozen=True)
class Glints:
    """Reflections of lamps, different in each camera.

    Attributes
    ----------
    on_surface : int
        Number of glints on the phantom's surface.
    over_needle : int
        Number of additional streaks on the surface over the needle's path.
    on_needle : int
        Number of glints on the shaft.
    largest : float
        Maximum length of a streak [m].
    brightness : float
        Maximum peak above the background [grey levels].
    flicker : float
        Relative change of the surface glints over time.
    """

    on_surface: int
    over_needle: int
    on_needle: int
    largest: float
    brightness: float
    flicker: float = 0.0


@dataclasses.dataclass(frozen=True)
class Lighting:
    """Uneven and changing light.

    Attributes
    ----------
    blotches : float
        Relative standard deviation of the light over the phantom.
    shade : float
        Relative darkness of a soft shade on one side.
    drift : float
        Relative amplitude of the light's drift.
    """

    blotches: float
    shade: float
    drift: float


@dataclasses.dataclass(frozen=True)
class FloorShadow:
    """Shadow of the needle on the phantom's floor.

    Attributes
    ----------
    floor_depth : float
        Depth of the floor under the surface [m].
    darkness : float
        Share of the light that it removes.
    largest_slant : float
        Maximum tangent of the light's angle from the vertical, across and along the needle.
    penumbra : float
        Width of its edge per height above the floor, due to the size of the lamp.
    """

    floor_depth: float = 0.035
    darkness: float = 0.5
    largest_slant: float = 0.25
    penumbra: float = 0.02


@dataclasses.dataclass(frozen=True)
class MetalShaft:
    """Bare metal needle, which mirrors a lamp along part of its shaft.

    Attributes
    ----------
    rim : float
        Brightness where it mirrors the room [grey levels].
    core : float
        Brightness where it mirrors the lamp [grey levels].
    core_width : float
        Width of the mirrored lamp relative to that of the needle.
    spread : float
        Rotation of the shaft at which the lamp has faded to a third [rad].
    """

    rim: float = 70.0
    core: float = 240.0
    core_width: float = 0.45
    spread: float = 0.15


@dataclasses.dataclass(frozen=True)
class Lens:
    """Defocused thin lens, with its circle of confusion.

    Attributes
    ----------
    focus_height : float
        Height of the focal plane above the needle's entry, along the window's normal towards the
        camera; x in `rig` for cameras above [m].
    aperture : float
        Diameter of the entrance pupil [m].
    """

    focus_height: float
    aperture: float


@dataclasses.dataclass(frozen=True)
class Scenario:
    """Disturbances of the images of a run.

    Attributes
    ----------
    name : str
        Name in `SCENARIOS`.
    summary : str
        Description for the user.
    noise : float
        Standard deviation of the sensor noise [grey levels].
    needle : bool
        Whether the images show a needle.
    bubbles, glints, lighting, shadow, lens, metal
        Disturbances; None if absent.
    cable, occlusion, paper : bool
        Whether a thin dark cable moves over the phantom, hands pass and cameras are covered, ruled
        paper lies on the phantom's floor; see `clutter`.

    Raises
    ------
    OutOfBoundsError
        If `noise` is not between 0 and 50 grey levels.
    """

    name: str
    summary: str
    noise: float = 3.0
    needle: bool = True
    bubbles: Bubbles | None = None
    glints: Glints | None = None
    lighting: Lighting | None = None
    shadow: FloorShadow | None = None
    lens: Lens | None = None
    metal: MetalShaft | None = None
    cable: bool = False
    occlusion: bool = False
    paper: bool = False

    def __post_init__(self) -> None:
        check_bounds("noise", self.noise, 0.0, 50.0, "grey levels")


CLEAN = Scenario("clean", "clear phantom in good light")
_CLUTTER = Scenario(
    "clutter",
    "bubbles, glints on surface and needle, uneven drifting light, more noise",
    noise=4.0,
    bubbles=Bubbles(70, 0.00015, 0.0012),
    glints=Glints(22, 2, 4, 0.005, 150.0),
    lighting=Lighting(0.06, 0.15, 0.06),
)
_HEAVY_CLUTTER = Scenario(
    "heavy_clutter",
    "more and larger clutter, glints over the needle, its shadow on the floor, a moving cable",
    noise=5.0,
    bubbles=Bubbles(170, 0.00015, 0.0022),
    glints=Glints(40, 5, 7, 0.007, 240.0, flicker=0.4),
    lighting=Lighting(0.09, 0.3, 0.1),
    shadow=FloorShadow(),
    cable=True,
)
_ALL = (
    CLEAN,
    _CLUTTER,
    _HEAVY_CLUTTER,
    dataclasses.replace(
        _HEAVY_CLUTTER,
        name="occlusion",
        summary="heavy clutter; hands pass, one or both cameras are blocked for a while",
        occlusion=True,
    ),
    dataclasses.replace(
        _HEAVY_CLUTTER,
        name="absent",
        summary="heavy clutter without a needle, also while the stage moves",
        needle=False,
    ),
    Scenario(
        "defocus",
        "cameras focused above the phantom: blur increases with depth",
        noise=4.0,
        bubbles=Bubbles(45, 0.0002, 0.0015),
        lighting=Lighting(0.04, 0.1, 0.03),
        lens=Lens(focus_height=0.065, aperture=0.011),
    ),
    Scenario(
        "steel",
        "bare needle that mirrors a lamp along part of its shaft, dark where it bends away",
        metal=MetalShaft(),
        lighting=Lighting(0.04, 0.1, 0.03),
    ),
    Scenario(
        "steel_on_graph_paper",
        "bare needle over ruled paper at an angle",
        metal=MetalShaft(),
        lighting=Lighting(0.04, 0.1, 0.03),
        paper=True,
    ),
    Scenario(
        "hard_shadow",
        "small lamp: the needle's shadow is as dark and continuous as the needle, close beside it",
        lighting=Lighting(0.04, 0.1, 0.03),
        shadow=FloorShadow(0.027, 0.75, 0.3, 0.003),
    ),
)
SCENARIOS = {scenario.name: scenario for scenario in _ALL}
"""Scenarios by name."""


def find_scenario(name: str) -> Scenario:
    """Return a named scenario.

    Raises
    ------
    UserError
        If the name is unknown.
    """
    try:
        return SCENARIOS[name]
    except KeyError:
        raise UserError(f"scenario {name!r} is not one of {', '.join(SCENARIOS)}") from None
