"""Proof that no path to a target exists, by a flood fill; compiled.

The cells that a path may pass are filled plane by plane, from the entry on. The conditions on them
are necessary, not sufficient: if the fill does not reach the target, no path does. They hold for
every curve whose curvature nowhere exceeds kappa:

- A point at a distance D lies outside the circles that touch the curve's heading, so its direction
  differs from the heading by at most bend(D) = asin(kappa D / 2). So for points a, b, c of the
  curve, in order: angle(b - a, c - b) <= bend(|b - a|) + bend(|c - b|).
- Between points at a distance D the curve is within sag(D) = R - sqrt(R^2 - D^2 / 4), R = 1 /
  kappa, of their chord. A chord nearer to an obstacle's axis than radius + clearance - sag is
  blocked.

A cell of the grid stands for all points within rho of its middle: lengths are uncertain by rho, and
directions by asin(rho / length). The needle always moves forward, within 90 deg of its heading at
the entry.
"""

# Numba functions take positional arguments: keywords are slow or unsupported.
# ruff: noqa: PLR0917
from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.planning.obstacles import segment_distance
from needle_controller.planning.path_evaluation import PathProblem
from needle_core.compiled import compiled

_PLANES_APART = 0.010
"""Largest distance between two planes [m], over which a needle bends 0.1 mm sideways."""
_CELL = 0.0005
_UNCERTAIN = _CELL / math.sqrt(2.0)
"""rho, the distance of a cell's corners from its middle [m]."""
_ENTRY = np.zeros(3)
_Cells = npt.NDArray[np.bool_]


def may_have_path(problem: PathProblem) -> bool:
    """Return False if there is certainly no path to the target.

    Parameters
    ----------
    problem : PathProblem
        Task of the path, whose start is the entry, with a known pose.
    """
    settings, table, tolerance = problem.settings, problem.table, problem.settings.goal_tolerance
    axes, tip = problem.start[:, :3], problem.start[:, 3]
    goal = (problem.target - tip) @ axes
    if goal[2] <= tolerance:
        return False
    ends = (table[:, :6].reshape(-1, 2, 3) - tip) @ axes
    capsules = np.column_stack([ends.reshape(-1, 6), table[:, 6] + settings.least_clearance])
    return bool(_fill(goal, problem.curvature, capsules, tolerance))


@compiled
def _fill(goal: Array, curvature: float, capsules: Array, tolerance: float) -> bool:
    """Return whether the fill reaches the target; all in the entry's axes, with z the heading."""
    # Paths end in a ball around the target: fill up to the first plane that touches it.
    depth = goal[2] - tolerance
    planes = math.ceil(depth / _PLANES_APART)
    aside = _sag(_distance(_ENTRY, goal) + tolerance, curvature) + 4.0 * (tolerance + _CELL)
    middle = math.ceil(aside / _CELL)
    size = 2 * middle + 1
    before, here = np.zeros((size, size), np.bool_), np.zeros((size, size), np.bool_)
    before[middle, middle] = True
    box = (middle, middle, middle, middle)
    first, cell, slope = np.zeros(3), np.empty(3), goal[:2] / goal[2]
    for k in range(planes):
        first[2], cell[2] = depth * k / planes, depth * (k + 1) / planes
        here[:] = False
        low_i, high_i, low_j, high_j = size, -1, size, -1
        for i in range(size):
            for j in range(size):
                cell[0] = slope[0] * cell[2] + (i - middle) * _CELL
                cell[1] = slope[1] * cell[2] + (j - middle) * _CELL
                arrival = _largest_bend(_distance(_ENTRY, cell), _UNCERTAIN, curvature)
                ahead = _largest_bend(_distance(cell, goal), tolerance + _UNCERTAIN, curvature)
                if math.atan2(math.hypot(cell[0], cell[1]), cell[2]) > arrival:
                    continue
                if _corner(_ENTRY, cell, goal) > arrival + ahead:
                    continue
                if _is_entered(cell, goal, ahead, first, before, box, curvature, capsules):
                    here[i, j] = True
                    low_i, high_i = min(low_i, i), max(high_i, i)
                    low_j, high_j = min(low_j, j), max(high_j, j)
        if high_i < 0:
            return False
        if min(low_i, low_j) == 0 or max(high_i, high_j) == size - 1:
            # The grid is too small for a decision.
            return True
        box = (low_i, high_i, low_j, high_j)
        before, here = here, before
    return True


@compiled
def _is_entered(
    cell: Array,
    goal: Array,
    ahead: float,
    first: Array,
    before: _Cells,
    box: tuple[int, int, int, int],
    curvature: float,
    capsules: Array,
) -> bool:
    """Return whether a cell can be reached from one of the previous plane, at first[2]."""
    middle = before.shape[0] // 2
    for i in range(box[0], box[1] + 1):
        for j in range(box[2], box[3] + 1):
            if not before[i, j]:
                continue
            first[0] = goal[0] / goal[2] * first[2] + (i - middle) * _CELL
            first[1] = goal[1] / goal[2] * first[2] + (j - middle) * _CELL
            step, came = _distance(first, cell), _distance(_ENTRY, first)
            turn = _largest_bend(step, 2.0 * _UNCERTAIN, curvature)
            if _corner(_ENTRY, first, cell) > _largest_bend(came, _UNCERTAIN, curvature) + turn:
                continue
            if _corner(first, cell, goal) > turn + ahead:
                continue
            slack = _UNCERTAIN + _sag(step + 2.0 * _UNCERTAIN, curvature)
            clear = True
            for k in range(len(capsules)):
                distance = segment_distance(first, cell, capsules[k], capsules[k, 3:])
                if distance < capsules[k, 6] - slack:
                    clear = False
                    break
            if clear:
                return True
    return False


@compiled
def _largest_bend(distance: float, uncertain: float, curvature: float) -> float:
    """Return the largest angle between a heading and the direction to an uncertain point [rad]."""
    bend = math.asin(min(0.5 * curvature * (distance + uncertain), 1.0))
    return bend + (math.asin(uncertain / distance) if distance > uncertain else math.pi)


@compiled
def _sag(distance: float, curvature: float) -> float:
    radius = 1.0 / curvature
    return radius - math.sqrt(max(radius * radius - 0.25 * distance * distance, 0.0))


@compiled
def _distance(first: Array, second: Array) -> float:
    x, y, z = second[0] - first[0], second[1] - first[1], second[2] - first[2]
    return math.sqrt(x * x + y * y + z * z)


@compiled
def _corner(first: Array, second: Array, third: Array) -> float:
    """Return the turn at the second of three points [rad]."""
    ax, ay, az = second[0] - first[0], second[1] - first[1], second[2] - first[2]
    bx, by, bz = third[0] - second[0], third[1] - second[1], third[2] - second[2]
    x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return math.atan2(math.sqrt(x * x + y * y + z * z), ax * bx + ay * by + az * bz)
