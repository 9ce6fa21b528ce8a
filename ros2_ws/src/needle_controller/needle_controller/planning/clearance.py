"""Whether a path is clear, and by how much; compiled."""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import math

import numpy as np

from needle_controller.model.arrays import Array
from needle_controller.planning.legs import MOST_POINTS, cut_short, leg_length, leg_towards, trace
from needle_controller.planning.path_settings import PathSettings, Unknown
from needle_controller.planning.segments import segment_distance
from needle_core.compiled import compiled


@compiled
def needed(length: float, unknown: Unknown, settings: PathSettings) -> float:
    """Return what a path's axis must be clear by at a length from its beginning [m].

    What is unknown of the pose now carries the needle aside until new tips have shown it, and is
    steered back after that: it counts less and less up to `correction_length`.
    """
    ahead = max(1.0 - length / settings.correction_length, 0.0)
    astray = math.hypot(unknown.position_std, unknown.heading_std * length) * ahead
    return settings.needle_radius + settings.sigmas * math.hypot(settings.settled_std, astray)


@compiled
def chain_margin(
    points: Array, count: int, table: Array, unknown: Unknown, settings: PathSettings, least: float
) -> float:
    """Return by what a chain is clearer than it must be, of the worst place [m].

    Parameters
    ----------
    points : ndarray, shape (M, 4)
        Its corners, and the path's length there; the first `count` count.
    count : int
        See `points`.
    table : ndarray, shape (N, 7)
        See `Obstacles`.
    unknown : Unknown
        At length 0.
    settings : PathSettings
        What must be clear.
    least : float
        Below this the chain is given up: the rest is not looked at [m].
    """
    margin = math.inf
    for i in range(1, count):
        wanted = max(
            needed(points[i - 1, 3], unknown, settings), needed(points[i, 3], unknown, settings)
        )
        for k in range(table.shape[0]):
            distance = segment_distance(points[i - 1], points[i], table[k], table[k, 3:])
            margin = min(margin, distance - table[k, 6] - wanted)
        if margin < least:
            return margin
    return margin


@compiled
def assess(
    start: Array,
    legs: Array,
    curvature: float,
    table: Array,
    unknown: Unknown,
    settings: PathSettings,
) -> tuple[float, float, float, float, float]:
    """Return length, margin, margin of the beginning, miss and scarcity of a path [m].

    The beginning is `committed_length`. Its margin is that of a needle whose pose is known.

    Parameters
    ----------
    start : ndarray, shape (3, 4)
        The tip's pose.
    legs : ndarray, shape (M, 4)
        What each is steered towards [m], and its greatest length [m], which becomes its length:
        written.
    curvature : float
        kappa [1/m].
    table : ndarray, shape (N, 7)
        See `Obstacles`.
    unknown : Unknown
        How well the pose is known.
    settings : PathSettings
        What must be clear.
    """
    pose, end, points = start.copy(), np.empty((3, 4)), np.empty((MOST_POINTS, 4))
    length, margin, beginning, miss, scarce = 0.0, math.inf, math.inf, 0.0, 0.0
    known = Unknown(0.0, 0.0)
    for i in range(legs.shape[0]):
        leg = leg_towards(
            pose, legs[i], curvature, settings.curvature_share, settings.max_rotation_per_length
        )
        leg = cut_short(leg, legs[i, 3])
        count = trace(pose, leg, curvature, length, points, end)
        margin = min(margin, chain_margin(points, count, table, unknown, settings, -math.inf))
        near = 1
        while near < count and points[near, 3] <= settings.committed_length:
            near += 1
        clear = chain_margin(points, near, table, known, settings, -math.inf)
        beginning = min(beginning, clear)
        miss, scarce = leg.miss, leg.scarce
        legs[i, 3] = leg_length(leg)
        length += legs[i, 3]
        pose[:] = end
    return length, margin, beginning, miss, scarce
