"""The search for a path: a tree of legs over via points, grown point by point; compiled.

Every path is a chain of legs (`legs`), each towards a via point and the last towards the target.
Nodes of the tree are tips after legs that are clear of all obstacles. Each point is reached from
the nodes from where that is shortest, and from each new node the target is tried (a rapidly
exploring tree, LaValle and Kuffner 2001, that chooses its parents by cost as RRT* does, Karaman and
Frazzoli 2011). The points are a fixed sequence: the same question has the same answer.
"""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.planning.clearance import chain_margin
from needle_controller.planning.legs import (
    MOST_POINTS,
    cut_short,
    leg_length,
    leg_towards,
    trace,
)
from needle_controller.planning.path_settings import PathSettings, Unknown
from needle_core.compiled import compiled

MOST_VIA_POINTS = 6
_SHORTEST_LEG = 0.004
_PARENTS_TRIED = 6
_PARENTS_TAKEN = 2
_Indices = npt.NDArray[np.int64]


class _Tree(NamedTuple):
    """Nodes of a tree: tips, with length and margin of the way there, and where it came from."""

    poses: Array
    length: Array
    margin: Array
    parent: _Indices
    via: _Indices
    depth: _Indices


@compiled
def search(
    start: Array,
    target: Array,
    curvature: float,
    table: Array,
    candidates: Array,
    unknown: Unknown,
    settings: PathSettings,
    reach: float,
    via_points: Array,
) -> int:
    """Find a path; write its via points and return their number, -1 where there is no path.

    Parameters
    ----------
    start : ndarray, shape (3, 4)
        The tip's pose.
    target : ndarray, shape (3,)
        Where to [m].
    curvature : float
        kappa [1/m].
    table : ndarray, shape (N, 7)
        See `Obstacles`.
    candidates : ndarray, shape (M, 4)
        Points that the tree grows to, in this order, and how far at most [m].
    unknown : Unknown
        How well the pose is known.
    settings : PathSettings
        Limits and costs.
    reach : float
        Longest that the path may be [m].
    via_points : ndarray, shape (>= MOST_VIA_POINTS, 4), written
        Those of the path, and its greatest length towards each [m].
    """
    most = 1 + _PARENTS_TAKEN * candidates.shape[0]
    tree = _Tree(
        np.empty((most, 3, 4)),
        np.zeros(most),
        np.full(most, settings.comfort),
        np.full(most, -1),
        np.full(most, -1),
        np.zeros(most, np.int64),
    )
    tree.poses[0] = start
    points, end = np.empty((MOST_POINTS, 4)), np.empty((3, 4))
    near, ways = np.empty(_PARENTS_TRIED, np.int64), np.empty(_PARENTS_TRIED)
    rate = settings.max_rotation_per_length
    best, best_cost, nodes, tried = -1, math.inf, 1, 0
    for k in range(-1, candidates.shape[0]):
        if k >= 0:
            found = _parents(tree, nodes, candidates[k], curvature, near, ways)
            longest = min(best_cost, reach)
            first = nodes
            for i in range(found):
                if nodes - first == _PARENTS_TAKEN:
                    break
                nodes += _grow(
                    tree,
                    nodes,
                    near[i],
                    k,
                    candidates[k],
                    target,
                    curvature,
                    table,
                    unknown,
                    settings,
                    longest,
                    points,
                    end,
                )
        while tried < nodes:
            cost = _cost_of_ending(
                tree, tried, target, curvature, table, unknown, settings, reach, points, end
            )
            if cost < best_cost:
                best, best_cost = tried, cost
            tried += 1
        if best == 0 and k < 0:
            leg = leg_towards(start, target, curvature, settings.curvature_share, rate)
            if best_cost <= leg_length(leg):
                # It lacks nothing: no way over via points is shorter.
                break
    if best < 0:
        return -1
    count = tree.depth[best]
    for i in range(count - 1, -1, -1):
        via_points[i] = candidates[tree.via[best]]
        best = tree.parent[best]
    return int(count)


@compiled
def _grow(
    tree: _Tree,
    new: int,
    node: int,
    k: int,
    candidate: Array,
    target: Array,
    curvature: float,
    table: Array,
    unknown: Unknown,
    settings: PathSettings,
    longest: float,
    points: Array,
    end: Array,
) -> int:
    """Write a node that is reached from another towards a point, if it is clear; return 1 if so."""
    rate = settings.max_rotation_per_length
    leg = leg_towards(tree.poses[node], candidate, curvature, settings.curvature_share, rate)
    leg = cut_short(leg, candidate[3])
    total = tree.length[node] + leg_length(leg)
    count = trace(tree.poses[node], leg, curvature, tree.length[node], points, end)
    if total + _distance(end, target) > longest:
        return 0
    clear = chain_margin(points, count, table, unknown, settings, 0.0)
    if clear < 0.0:
        return 0
    tree.poses[new], tree.length[new] = end, total
    tree.margin[new] = min(clear, tree.margin[node])
    tree.parent[new], tree.via[new], tree.depth[new] = node, k, tree.depth[node] + 1
    return 1


@compiled
def _cost_of_ending(
    tree: _Tree,
    node: int,
    target: Array,
    curvature: float,
    table: Array,
    unknown: Unknown,
    settings: PathSettings,
    reach: float,
    points: Array,
    end: Array,
) -> float:
    """Return the cost of the path that goes from a node to the target [m]; inf if it is none."""
    rate = settings.max_rotation_per_length
    leg = leg_towards(tree.poses[node], target, curvature, settings.curvature_share, rate)
    total = tree.length[node] + leg_length(leg)
    if leg.scarce > 0.0 or total > reach:
        return math.inf
    count = trace(tree.poses[node], leg, curvature, tree.length[node], points, end)
    clear = chain_margin(points, count, table, unknown, settings, 0.0)
    if clear < 0.0:
        return math.inf
    lacking = settings.comfort - min(clear, tree.margin[node])
    return float(total + settings.comfort_price * lacking)


@compiled
def _distance(pose: Array, point: Array) -> float:
    x, y, z = pose[0, 3] - point[0], pose[1, 3] - point[1], pose[2, 3] - point[2]
    return math.sqrt(x * x + y * y + z * z)


@compiled
def _parents(
    tree: _Tree, nodes: int, point: Array, curvature: float, near: _Indices, ways: Array
) -> int:
    """Write the nodes from where a point is reached soonest, and the straight way from each [m]."""
    found = 0
    for i in range(nodes):
        if tree.depth[i] == MOST_VIA_POINTS:
            continue
        pose = tree.poses[i]
        x, y, z = point[0] - pose[0, 3], point[1] - pose[1, 3], point[2] - pose[2, 3]
        ahead = x * pose[0, 2] + y * pose[1, 2] + z * pose[2, 2]
        if ahead < _SHORTEST_LEG:
            continue
        squared = x * x + y * y + z * z
        aside = math.sqrt(max(squared - ahead * ahead, 0.0))
        if squared * curvature < 2.0 * aside:
            # Within the circle of the bend.
            continue
        way = math.sqrt(squared)
        place = found
        while place > 0 and tree.length[near[place - 1]] + ways[place - 1] > tree.length[i] + way:
            if place < _PARENTS_TRIED:
                near[place], ways[place] = near[place - 1], ways[place - 1]
            place -= 1
        if place < _PARENTS_TRIED:
            near[place], ways[place] = i, way
            found = min(found + 1, _PARENTS_TRIED)
    return found
