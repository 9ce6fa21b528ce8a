"""Troubles of the simulated cameras: named scenarios, from clean images to blocked cameras.

A scenario is data. What stands where and when follows from it, the seed and the exposure's number.
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
        How many.
    smallest, largest : float
        Bounds of their radii; small ones are the more frequent [m].
    """

    count: int
    smallest: float
    largest: float


@dataclasses.dataclass(frozen=True)
class Glints:
    """Reflections of lamps; each camera sees others.

    Attributes
    ----------
    on_surface : int
        How many on the phantom's surface.
    over_needle : int
        How many streaks on the surface, more, that lie over the needle's way.
    on_needle : int
        How many stretches of the shaft shaft_glints.
    largest : float
        Longest streak [m].
    brightness : float
        Largest peak above what is there [grey levels].
    flicker : float
        By which share the surface's glints come and go.
    """

    on_surface: int
    over_needle: int
    on_needle: int
    largest: float
    brightness: float
    flicker: float = 0.0


@dataclasses.dataclass(frozen=True)
class Lighting:
    """Unevenness and unsteadiness of the light.

    Attributes
    ----------
    blotches : float
        Standard deviation of the light over the phantom, as a share.
    shade : float
        By which share one side of the image lies in something's soft shade.
    drift : float
        By which share the light swells and fades.
    drift_period : float
        Of the drift [exposures].
    """

    blotches: float
    shade: float
    drift: float
    drift_period: float = 90.0


@dataclasses.dataclass(frozen=True)
class Cable:
    """A thin dark line, such as a cable, that moves to and fro over the phantom.

    Attributes
    ----------
    diameter : float
        About the needle's, so that it looks like one [m].
    height : float
        Above the phantom's surface [m].
    sway : float
        How far it goes either way across the needle [m].
    period : float
        Of its motion [exposures].
    """

    diameter: float = 0.0007
    height: float = 0.003
    sway: float = 0.022
    period: float = 70.0


@dataclasses.dataclass(frozen=True)
class FloorShadow:
    """The needle's shadow on the phantom's floor.

    Attributes
    ----------
    floor_depth : float
        Of the floor under the surface [m].
    darkness : float
        Share of the light it takes.
    largest_slant : float
        Largest tangent of the light's angle from the vertical, across and along the needle.
    penumbra : float
        Width of its edge for each length of fall: a lamp is no point.
    """

    floor_depth: float = 0.035
    darkness: float = 0.5
    largest_slant: float = 0.25
    penumbra: float = 0.02


@dataclasses.dataclass(frozen=True)
class MetalShaft:
    """A needle that is not painted: it mirrors a lamp along part of its shaft.

    Attributes
    ----------
    rim : float
        Where it mirrors the room [grey levels].
    core : float
        Where it mirrors the lamp [grey levels].
    core_width : float
        Of the lamp_reflection lamp, over the needle's.
    spread : float
        How far the shaft may turn until the lamp has faded to a third [rad].
    """

    rim: float = 70.0
    core: float = 240.0
    core_width: float = 0.45
    spread: float = 0.15


@dataclasses.dataclass(frozen=True)
class GraphPaper:
    """Ruled paper on the phantom's floor.

    Attributes
    ----------
    floor_depth : float
        Of the floor under the surface [m].
    pitch : float
        From line to line [m].
    line_width : float
        Of each [m].
    grey : float
        Of the lines [grey levels].
    """

    floor_depth: float = 0.035
    pitch: float = 0.005
    line_width: float = 0.0004
    grey: float = 95.0


@dataclasses.dataclass(frozen=True)
class Occlusion:
    """Hands over the phantom and covered cameras, one event in every so many exposures.

    Attributes
    ----------
    first : int
        Exposures without any at the beginning.
    every : int
        One event in each stretch of so many exposures [exposures].
    length : int
        Of an event that leaves one camera its view [exposures].
    length_both : int
        Of an event that leaves none [exposures].
    """

    first: int = 20
    every: int = 40
    length: int = 14
    length_both: int = 6


@dataclasses.dataclass(frozen=True)
class Lens:
    """A lens that is not focused on the needle; a thin lens's circle of confusion.

    Attributes
    ----------
    focus_height : float
        Of what is sharp: from the needle's entry towards the camera, along its window's normal; x
        in `rig` for cameras above [m].
    aperture : float
        Diameter of the entrance pupil [m].
    """

    focus_height: float
    aperture: float


@dataclasses.dataclass(frozen=True)
class Scenario:
    """All troubles of the images of one run.

    Attributes
    ----------
    name : str
        As in `SCENARIOS`.
    summary : str
        One line for a person.
    noise : float
        Standard deviation of the sensor's noise [grey levels].
    needle : bool
        Whether there is a needle to be seen.
    bubbles, glints, lighting, cable, shadow, occlusion, lens, metal, paper
        The troubles; None where there are none.

    Raises
    ------
    OutOfBoundsError
        If `noise` is not within 0 and 50 grey levels.
    """

    name: str
    summary: str
    noise: float = 3.0
    needle: bool = True
    bubbles: Bubbles | None = None
    glints: Glints | None = None
    lighting: Lighting | None = None
    cable: Cable | None = None
    shadow: FloorShadow | None = None
    occlusion: Occlusion | None = None
    lens: Lens | None = None
    metal: MetalShaft | None = None
    paper: GraphPaper | None = None

    def __post_init__(self) -> None:
        check_bounds("noise", self.noise, 0.0, 50.0, "grey levels")


CLEAN = Scenario("clean", "a clear phantom in good light")
_CLUTTER = Scenario(
    "clutter",
    "bubbles, glints on surface and needle, uneven light that drifts, more noise",
    noise=4.0,
    bubbles=Bubbles(70, 0.00015, 0.0012),
    glints=Glints(22, 2, 4, 0.005, 150.0),
    lighting=Lighting(0.06, 0.15, 0.06),
)
_HEAVY_CLUTTER = Scenario(
    "heavy_clutter",
    "more and bigger of these, glints over the needle, its shadow on the floor, a cable that moves",
    noise=5.0,
    bubbles=Bubbles(170, 0.00015, 0.0022),
    glints=Glints(40, 5, 7, 0.007, 240.0, flicker=0.4),
    lighting=Lighting(0.09, 0.3, 0.1),
    cable=Cable(),
    shadow=FloorShadow(),
)
_ALL = (
    CLEAN,
    _CLUTTER,
    _HEAVY_CLUTTER,
    dataclasses.replace(
        _HEAVY_CLUTTER,
        name="occlusion",
        summary="heavy clutter; hands pass over, one camera or both are blocked for a while",
        occlusion=Occlusion(),
    ),
    dataclasses.replace(
        _HEAVY_CLUTTER,
        name="absent",
        summary="heavy clutter without a needle, whatever the stage does",
        needle=False,
    ),
    Scenario(
        "defocus",
        "cameras focused above the phantom: the deeper, the more blurred",
        noise=4.0,
        bubbles=Bubbles(45, 0.0002, 0.0015),
        lighting=Lighting(0.04, 0.1, 0.03),
        lens=Lens(focus_height=0.065, aperture=0.011),
    ),
    Scenario(
        "steel",
        "a bare needle that mirrors a lamp along part of its shaft, dark where it bends away",
        metal=MetalShaft(),
        lighting=Lighting(0.04, 0.1, 0.03),
    ),
    Scenario(
        "steel_on_graph_paper",
        "the same over ruled paper that lies askew",
        metal=MetalShaft(),
        lighting=Lighting(0.04, 0.1, 0.03),
        paper=GraphPaper(),
    ),
    Scenario(
        "hard_shadow",
        "a small lamp: the needle's shadow is as dark and whole as the needle, close beside it",
        lighting=Lighting(0.04, 0.1, 0.03),
        shadow=FloorShadow(0.027, 0.75, 0.3, 0.003),
    ),
)
SCENARIOS = {scenario.name: scenario for scenario in _ALL}
"""The named scenarios."""


def find_scenario(name: str) -> Scenario:
    """Return a named scenario.

    Raises
    ------
    UserError
        If there is none of this name.
    """
    try:
        return SCENARIOS[name]
    except KeyError:
        raise UserError(f"scenario {name!r} is not one of {', '.join(SCENARIOS)}") from None
