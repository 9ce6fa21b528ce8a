"""A planner of another package: tried when it is loaded, its via points checked at every step."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np

from needle_controller.model.arrays import Array
from needle_controller.planning.entry import entry_state
from needle_controller.planning.obstacles import Obstacles
from needle_controller.planning.path_planner import TipState
from needle_controller.presets.own_parts import OwnPart, own_part
from needle_controller.presets.steering_settings import SteeringSettings

_MEANING = "via points x, y, z in rig [m], the target last"
_AT_TARGET = 1e-6


@dataclasses.dataclass(frozen=True)
class Route:
    """A way that the needle is led along: what it is steered towards, and how long it is.

    Attributes
    ----------
    aim : ndarray, shape (3,)
        In `rig` [m].
    length : float or None
        Of the whole [m]; None where `aim` is the target.
    """

    aim: Array
    length: float | None


class OwnPlanner:
    """An own planner.

    Parameters
    ----------
    part : OwnPart
        Which.
    settings : SteeringSettings
        Of the controller.
    """

    def __init__(self, part: OwnPart, settings: SteeringSettings) -> None:
        self._part = part
        with part.blamed(f"{part.made_by.__name__}(settings)"):
            self._own = part.made_by(settings)

    def route(self, tip: TipState, target: Array, obstacles: Obstacles) -> Route | None:
        """Return the way from a tip to a target, None where the planner sees none.

        Raises
        ------
        OwnPartError
            What it raises, and points that are none or do not end at the target.
        """
        part = self._part
        with part.blamed("via_points"):
            said = self._own.via_points(tip, target.copy(), obstacles.table.copy())
        if said is None:
            return None
        count = len(said) if np.ndim(said) == 2 else 1
        points = part.checked("via_points()", said, (count, 3), _MEANING)
        if count < 1 or float(np.linalg.norm(points[-1] - target)) > _AT_TARGET:
            raise part.error(f"via_points() does not end at the target {target.tolist()} m")
        if count == 1:
            return Route(target, None)
        way = np.diff(np.vstack([tip.position, points]), axis=0)
        return Route(points[0], float(np.sum(np.linalg.norm(way, axis=1))))

    def why_not(self, obstacles: Obstacles) -> str:
        """Return what is said where there is no way at the start."""
        return (
            f"planner {self._part.name} finds no path to the target point past "
            f"{len(obstacles)} obstacles"
        )


@cache
def tried_planner(name: str) -> OwnPart:
    """Return an own planner's class that has been asked for a way straight ahead.

    Raises
    ------
    OwnPartError
        As of `own_part`; also where it raises, or what it says is no way.
    """
    part = own_part("planner", name)
    settings = SteeringSettings()
    tip = entry_state(settings.curvature)
    OwnPlanner(part, settings).route(tip, np.array([0.0, 0.0, 0.08]), Obstacles([]))
    return part
