"""Whether a needle that is still out can reach its target, and from where it could."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import rotation_from_angles
from needle_controller.planning.obstacles import Obstacles
from needle_controller.planning.path_planner import NeedlePath, PathPlanner, TipState
from needle_controller.planning.path_search import THOROUGH_STARTS

_OFFSETS = (0.001, 0.002, 0.004, 0.007, 0.011, 0.016)
"""Distances at which other entries are looked for [m]."""
_AROUND = 8


def entry_state(
    curvature: float,
    *,
    rotation: float = 0.0,
    x: float = 0.0,
    y: float = 0.0,
    pitch: float = 0.0,
    yaw: float = 0.0,
    heading_std: float = 0.0,
) -> TipState:
    """Return a needle's tip at its entry.

    Parameters
    ----------
    curvature : float
        kappa [1/m].
    rotation : float
        Of the base [rad].
    x, y : float
        Where it enters, from the rig's entry point [m].
    pitch, yaw : float
        Its heading [rad].
    heading_std : float
        How well that is known [rad].
    """
    angles = rotation_from_angles([yaw, pitch, rotation])
    return TipState(np.array([x, y, 0.0]), angles, curvature, heading_std=heading_std)


@dataclasses.dataclass(frozen=True)
class NoPath:
    """Reason that a needle that is still out cannot set out.

    Attributes
    ----------
    why : str
        In words; with an entry from where there is a path, if one is near.
    exists_none : bool
        Whether no path exists for certain, rather than that none was found.
    """

    why: str
    exists_none: bool


def first_path(
    planner: PathPlanner, entry: TipState, target: npt.ArrayLike, obstacles: Obstacles
) -> NeedlePath | NoPath:
    """Return the path of a needle that is still out, or why there is none.

    Where the quick search finds nothing and none is proved, the thorough one is asked.

    Parameters
    ----------
    planner : PathPlanner
        Its settings say what must be clear.
    entry : TipState
        The needle's tip.
    target : array_like, shape (3,)
        In `rig` [m].
    obstacles : Obstacles
        What is in the way.
    """
    path = planner.path(entry, target, obstacles)
    if path is not None:
        return path
    clear = planner.settings.least_clear
    for name, point, wanted in (
        ("target point", target, clear - planner.settings.goal_tolerance),
        ("entry", entry.position, clear),
    ):
        if (there := obstacles.clearance(point)) < wanted:
            why = f"the {name} is {there:.4g} m from an obstacle, wants >= {wanted:.4g} m"
            return NoPath(why, exists_none=True)
    some = planner.may_have_path(entry, target, obstacles)
    path = planner.path(entry, target, obstacles, starts=THOROUGH_STARTS) if some else None
    if path is not None:
        return path
    is_clear = "was found clear" if some else "is clear"
    why = f"no path to the target point {is_clear} of the {len(obstacles)} obstacles"
    nearest = nearest_entry(planner, entry, target, obstacles)
    if nearest is None:
        why += f", nor is one from an entry up to {_OFFSETS[-1]:.4g} m beside it"
    else:
        why += "; entering at ({:.4g}, {:.4g}) m in place of (0, 0) there is one".format(*nearest)
    return NoPath(why, exists_none=not some)


def nearest_entry(
    planner: PathPlanner, entry: TipState, target: npt.ArrayLike, obstacles: Obstacles
) -> Array | None:
    """Return the nearest entry (x, y) [m], on rings around one, from where there is a path.

    Parameters as of `first_path`. The needle keeps its heading and its bevel.
    """
    for offset, k in itertools.product(_OFFSETS, range(_AROUND)):
        angle = 2.0 * math.pi * k / _AROUND
        moved = entry.position + offset * np.array([math.cos(angle), math.sin(angle), 0.0])
        if planner.path(dataclasses.replace(entry, position=moved), target, obstacles) is not None:
            return np.asarray(moved[:2])
    return None
