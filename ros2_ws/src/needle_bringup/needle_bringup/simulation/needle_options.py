"""One needle in all nodes: what its options set where, and where parameters contradict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from needle_core.settings.parameter_files import Parameters

CURVATURE, DIAMETER, PRE_BEND, LEAN = 1.0 / 0.122, 0.7e-3, math.radians(10.0), math.radians(5.6)
"""The needle of [KC09], every node's default: curvature [1/m], diameter [m], bend, lean [rad]."""
_SEARCHED = 1.1
"""How much more curvature the tracker looks for."""
_LEAN_MARGIN = math.radians(6.4)
"""How much farther than it should the visible end may lean from the path."""
_RELATIVE = 1e-3
_GATES = {("sim_rig", "curvature"): ("stereo_tracker", "max_curvature", 9.0)}


class Shared(NamedTuple):
    """Value on which several nodes must agree.

    Attributes
    ----------
    what, option : str
        Its name, and the option of simulate that sets it everywhere.
    default : float or str
        Of every node.
    unit : str
        Of all.
    places : dict of str to str
        Node to its parameter.
    """

    what: str
    option: str
    default: float | str
    unit: str
    places: dict[str, str]


_CURVATURES = {"sim_rig": "curvature", "plane_controller": "curvature"}
_WIDTHS = {
    "sim_rig": "needle_diameter",
    "stereo_tracker": "needle_width",
    "plane_controller": "needle_diameter",
}
_FILES = {"sim_rig": "calibration_file", "stereo_tracker": "calibration_file"}
SHARED = (
    Shared("curvature", "--curvature", CURVATURE, "1/m", _CURVATURES),
    Shared("diameter", "--diameter-mm", DIAMETER, "m", _WIDTHS),
    Shared("calibration", "--params", "", "", _FILES),
)


def needle_parameters(
    curvature: float | None, diameter: float | None, pre_bend: float | None
) -> Parameters:
    """Return what the options of a needle set, alike in all nodes; None leaves the defaults.

    Parameters
    ----------
    curvature : float or None
        Of its path [1/m].
    diameter : float or None
        [m].
    pre_bend : float or None
        Angle between shaft and pre-bent end [rad]; the end leans by the same share of it as that of
        [KC09].
    """
    sim_rig: dict[str, Any] = {}
    tracker: dict[str, Any] = {}
    controller: dict[str, Any] = {}
    if curvature is not None:
        sim_rig["curvature"] = controller["curvature"] = curvature
        tracker["max_curvature"] = _SEARCHED * curvature
    if diameter is not None:
        sim_rig["needle_diameter"] = controller["needle_diameter"] = diameter
        tracker["needle_width"] = diameter
    if pre_bend is not None:
        lean = pre_bend * LEAN / PRE_BEND
        sim_rig["pre_bend"], sim_rig["pre_bend_lean"] = pre_bend, lean
        tracker["tip_lean"] = lean + _LEAN_MARGIN
    return {"sim_rig": sim_rig, "stereo_tracker": tracker, "plane_controller": controller}


def contradictions(parameters: Parameters, nodes: Sequence[str]) -> list[str]:
    """Return where nodes are told of different needles, a line each.

    Parameters
    ----------
    parameters : dict
        Of all nodes; what is not there is the default.
    nodes : sequence of str
        Which run.
    """
    found = []
    for shared in SHARED:
        told = {
            (node, name): parameters.get(node, {}).get(name, shared.default)
            for node, name in shared.places.items()
            if node in nodes
        }
        values = list(told.values())
        if all(_alike(value, values[0]) for value in values):
            continue
        words = ", ".join(
            f"{node} has {name} {_shown(value, shared.unit)}"
            for (node, name), value in told.items()
        )
        found.append(f"{shared.what} differs: {words} ({shared.option} sets it in all nodes)")
    for (node, name), (other, gate, default) in _GATES.items():
        most = parameters.get(other, {}).get(gate, default)
        value = parameters.get(node, {}).get(name, CURVATURE)
        if other in nodes and isinstance(value, float) and value > most:
            found.append(f"{node} has {name} {value:g}, but {other} looks for {gate} {most:g}")
    return found


def _alike(one: Any, other: Any) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=_RELATIVE)
    return bool(one == other)


def _shown(value: Any, unit: str) -> str:
    return f"{value:.4g} {unit}" if isinstance(value, float) else repr(value)
