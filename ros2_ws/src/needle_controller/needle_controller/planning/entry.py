"""Whether a needle that is still out can reach its target, and from where it could."""

from __future__ import annotations

import itertools
import math

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import rotation_from_angles
from needle_controller.planning.obstacles import Obstacles
from needle_controller.planning.path_planner import NeedlePath, PathPlanner, TipState

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


def why_unreachable(
    planner: PathPlanner, entry: TipState, target: npt.ArrayLike, obstacles: Obstacles
) -> str:
    """Return why no path leads from the entry to a target, and from where one does.

    Parameters
    ----------
    planner : PathPlanner
        Its settings say what must be clear.
    entry : TipState
        The needle's tip, for which there is no path.
    target : array_like, shape (3,)
        In `rig` [m].
    obstacles : Obstacles
        What is in the way.
    """
    settings = planner.settings
    wanted = settings.needle_radius + settings.sigmas * settings.settled_std
    for name, point in (("target point", target), ("entry", entry.position)):
        clearance = obstacles.clearance(point)
        if clearance < wanted:
            return f"the {name} is {clearance:.4g} m from an obstacle, wants >= {wanted:.4g} m"
    why = f"no path to the target point is clear of the {len(obstacles)} obstacles"
    nearest = nearest_entry(planner, entry, target, obstacles)
    if nearest is None:
        return f"{why}, nor is one from an entry up to {_OFFSETS[-1]:.4g} m beside it"
    x, y = nearest
    return f"{why}; entering at ({x:.4g}, {y:.4g}) m in place of (0, 0) there is one"


def nearest_entry(
    planner: PathPlanner, entry: TipState, target: npt.ArrayLike, obstacles: Obstacles
) -> Array | None:
    """Return the nearest entry (x, y) [m], on rings around one, from where there is a path.

    Parameters as of `why_unreachable`. The needle keeps its heading and its bevel.
    """
    for offset, k in itertools.product(_OFFSETS, range(_AROUND)):
        angle = 2.0 * math.pi * k / _AROUND
        moved = entry.position + offset * np.array([math.cos(angle), math.sin(angle), 0.0])
        tip = TipState(moved, entry.rotation, entry.curvature, heading_std=entry.heading_std)
        if planner.path(tip, target, obstacles) is not None:
            return np.asarray(moved[:2])
    return None


def first_path(
    planner: PathPlanner, entry: TipState, target: npt.ArrayLike, obstacles: Obstacles
) -> tuple[NeedlePath | None, str]:
    """Return the path of a needle that is still out, or why there is none.

    Parameters as of `why_unreachable`.
    """
    path = planner.path(entry, target, obstacles)
    return path, "" if path is not None else why_unreachable(planner, entry, target, obstacles)
