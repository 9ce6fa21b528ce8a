"""Whether a path is clear, and by how much; compiled."""

# Compiled code takes keywords slowly or not at all.
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from needle_controller.model.arrays import Array
from needle_controller.planning.legs import MOST_POINTS, cut_short, leg_length, leg_towards, trace
from needle_controller.planning.path_settings import PathSettings, Question, Unknown
from needle_controller.planning.segments import segment_distance
from needle_core.compiled import compiled

_COMFORT_PRICE, _PRICE_OF_MISS, _PRICE_OF_BROKEN = 4.0, 5.0, 100.0
"""Length that a path may be longer for each length by which it is clearer, up to `comfort`, by
which it passes the target less, and by which it breaks less of what it must keep."""


class Assessment(NamedTuple):
    """Verdict on a path; all in [m].

    Attributes
    ----------
    length : float
        Of the whole.
    margin : float
        By what it is clearer than it must be, at the worst place; inf without obstacles.
    beginning : float
        The same of its first `committed_length`, for a pose that is known.
    scarce : float
        Distance by which it would pass the target with `comfortable_share` of the curvature on its
        last leg; 0 where that leads there.
    broken : float
        By what it breaks what it must keep: clearance, goal tolerance, lengths; 0 of a path that
        may be followed.
    cost : float
        The less, the better.
    """

    length: float
    margin: float
    beginning: float
    scarce: float
    broken: float
    cost: float


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
    points: Array, count: int, table: Array, unknown: Unknown, settings: PathSettings
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
    """
    margin = math.inf
    for i in range(1, count):
        wanted = max(
            needed(points[i - 1, 3], unknown, settings), needed(points[i, 3], unknown, settings)
        )
        for k in range(table.shape[0]):
            distance = segment_distance(points[i - 1], points[i], table[k], table[k, 3:])
            margin = min(margin, distance - table[k, 6] - wanted)
    return margin


@compiled
def assess(legs: Array, question: Question, shortest: float) -> Assessment:
    """Return what is to be said of a path.

    Parameters
    ----------
    legs : ndarray, shape (M, 4)
        What each is steered towards, the target last, and its greatest length [m], which becomes
        its length: written.
    question : Question
        What it is an answer to.
    shortest : float
        Least length of a leg to a via point [m].
    """
    settings, table, known = question.settings, question.table, Unknown(0.0, 0.0)
    share = settings.comfortable_share / settings.curvature_share
    pose, end, points = question.start.copy(), np.empty((3, 4)), np.empty((MOST_POINTS, 4))
    length, margin, beginning, miss, scarce, short = 0.0, math.inf, math.inf, 0.0, 0.0, 0.0
    for i in range(legs.shape[0]):
        kappa = question.curvature
        leg = leg_towards(pose, legs[i], kappa, share, settings.max_rotation_per_length)
        leg = cut_short(leg, legs[i, 3])
        count = trace(pose, leg, kappa, length, points, end)
        margin = min(margin, chain_margin(points, count, table, question.unknown, settings))
        near = 1
        while near < count and points[near, 3] <= settings.committed_length:
            near += 1
        beginning = min(beginning, chain_margin(points, near, table, known, settings))
        miss, scarce = leg.miss, leg.scarce
        legs[i, 3] = leg_length(leg)
        length += legs[i, 3]
        if i + 1 < legs.shape[0]:
            short += max(shortest - legs[i, 3], 0.0)
        pose[:] = end
    # With a+ = max(a, 0): J = length + p_c (comfort - margin)+ + p_m scarce + p_b b,
    # b = (-margin)+ + (miss - tolerance)+ + (length - reach)+ + sum (shortest - length of a leg)+.
    broken = max(-margin, 0.0) + max(miss - settings.goal_tolerance, 0.0)
    broken += max(length - question.reach, 0.0) + short
    cost = length + _COMFORT_PRICE * max(settings.comfort - margin, 0.0)
    cost += _PRICE_OF_MISS * scarce + _PRICE_OF_BROKEN * broken
    return Assessment(length, margin, beginning, scarce, broken, cost)
