"""Paths of a needle before insertion: whether one exists, and for which entries."""

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
"""Radii of the rings on which other entries are tried [m]."""
_ENTRIES_PER_RING = 8


def entry_state(curvature: float, *, rotation: float = 0.0, heading_std: float = 0.0) -> TipState:
    """Return a needle's tip at the rig's entry point.

    Parameters
    ----------
    curvature : float
        kappa [1/m].
    rotation : float
        Rotation of the base [rad].
    heading_std : float
        Standard deviation of the heading [rad].
    """
    turned = rotation_from_angles([0.0, 0.0, rotation])
    return TipState(np.zeros(3), turned, curvature, heading_std=heading_std)


def first_path(
    planner: PathPlanner, entry: TipState, target: npt.ArrayLike, obstacles: Obstacles
) -> NeedlePath | str:
    """Return the path of a needle that is not yet inserted, or the reason why there is none.

    If the quick search finds no path and the flood fill does not rule one out, the thorough search
    follows. The reason distinguishes a proof ("no path is clear") from a failed search ("was found
    clear"), and names a nearby entry with a path, if any.

    Parameters
    ----------
    planner : PathPlanner
        Planner with the required clearance.
    entry : TipState
        The needle's tip.
    target : array_like, shape (3,)
        Target in `rig` [m].
    obstacles : Obstacles
        Obstacles to avoid.
    """
    path = planner.path(entry, target, obstacles)
    if path is not None:
        return path
    clear = planner.settings.least_clearance
    for name, point, minimum in (
        ("target point", target, clear - planner.settings.goal_tolerance),
        ("entry", entry.position, clear),
    ):
        if (distance := obstacles.clearance(point)) < minimum:
            return f"the {name} is {distance:.4g} m from an obstacle, minimum {minimum:.4g} m"
    possible = planner.may_have_path(entry, target, obstacles)
    path = planner.path(entry, target, obstacles, starts=THOROUGH_STARTS) if possible else None
    if path is not None:
        return path
    is_clear = "was found clear" if possible else "is clear"
    reason = f"no path to the target point {is_clear} of the {len(obstacles)} obstacles"
    nearest = nearest_entry(planner, entry, target, obstacles)
    if nearest is None:
        reason += f", nor from any entry up to {_OFFSETS[-1]:.4g} m from it"
    else:
        reason += "; there is one from an entry at ({:.4g}, {:.4g}) m instead of (0, 0)".format(
            *nearest
        )
    return reason


def nearest_entry(
    planner: PathPlanner, entry: TipState, target: npt.ArrayLike, obstacles: Obstacles
) -> Array | None:
    """Return the nearest entry (x, y) [m], on rings around a given one, from which there is a path.

    The parameters are those of `first_path`. Heading and rotation stay the same.
    """
    for offset, k in itertools.product(_OFFSETS, range(_ENTRIES_PER_RING)):
        angle = 2.0 * math.pi * k / _ENTRIES_PER_RING
        moved = entry.position + offset * np.array([math.cos(angle), math.sin(angle), 0.0])
        if planner.path(dataclasses.replace(entry, position=moved), target, obstacles) is not None:
            return np.asarray(moved[:2])
    return None
