"""Evaluation of a needle's path: settings, clearance from obstacles, and cost; compiled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from needle_controller.model.arrays import Array
from needle_controller.planning.legs import (
    MOST_POINTS,
    leg_length,
    leg_towards,
    trace_leg,
    truncated,
)
from needle_controller.planning.obstacles import segment_distance
from needle_core.compiled import compiled

_MARGIN_PRICE, _MISS_PRICE, _VIOLATION_PRICE = 4.0, 5.0, 100.0
"""Additional path length equivalent to a unit of clearance up to `preferred_margin`, of distance
from the target, and of violated constraints."""


# Read by compiled code.
class PathSettings(NamedTuple):
    """Settings of the path planner.

    Attributes
    ----------
    max_rotation_per_length : float
        Largest rotation of the bevel per inserted length [rad/m].
    curvature_share : float
        Share of the curvature used for planning; the rest is left for corrections.
    gentle_share : float
        Preferred largest share of the curvature on the last leg.
    needle_radius : float
        Radius of the needle [m].
    sigmas : float
        Number of standard deviations of the position that must be clear in addition to the needle's
        radius.
    tracking_std : float
        Standard deviation of the distance between the needle and its path [m].
    correction_length : float
        Insertion over which an initial error is observed and corrected [m].
    committed_length : float
        Length over which a path must be clear for the present estimate [m]. The rest is replanned
        with new observations before the needle gets there.
    preferred_margin : float
        Preferred clearance beyond the required one [m].
    goal_tolerance : float
        Largest distance of a path's end from the target [m].
    longest : float
        Largest length of a path from the entry [m].
    """

    max_rotation_per_length: float
    curvature_share: float = 0.9
    gentle_share: float = 0.8
    needle_radius: float = 0.00035
    sigmas: float = 2.0
    tracking_std: float = 0.0002
    correction_length: float = 0.03
    committed_length: float = 0.01
    preferred_margin: float = 0.0015
    goal_tolerance: float = 0.001
    longest: float = 0.2

    @property
    def least_clearance(self) -> float:
        """Required clearance of a path's axis if the pose is known [m]."""
        return self.needle_radius + self.sigmas * self.tracking_std


class PoseUncertainty(NamedTuple):
    """Uncertainty of the tip's pose at the beginning of a path.

    Attributes
    ----------
    position_std : float
        Standard deviation of the tip across the needle [m].
    heading_std : float
        Standard deviation of its heading [rad].
    """

    position_std: float
    heading_std: float


class PathProblem(NamedTuple):
    """Task of a path.

    Attributes
    ----------
    start : ndarray, shape (3, 4)
        Pose of the tip.
    target : ndarray, shape (3,)
        Position of the target [m].
    curvature : float
        Planned curvature, `curvature_share` of kappa [1/m].
    table : ndarray, shape (N, 7)
        See `Obstacles`.
    uncertainty : PoseUncertainty
        Uncertainty of `start`.
    reach : float
        Largest length of the path [m].
    settings : PathSettings
        Requirements.
    """

    start: Array
    target: Array
    curvature: float
    table: Array
    uncertainty: PoseUncertainty
    reach: float
    settings: PathSettings


class PathEvaluation(NamedTuple):
    """Evaluation of a path; all in [m].

    Attributes
    ----------
    length : float
        Length of the whole path.
    margin : float
        Least clearance beyond the required one; inf without obstacles.
    near_margin : float
        The same over the first `committed_length`, for a known pose.
    gentle_miss : float
        Distance by which the path would miss the target with `gentle_share` of the curvature on its
        last leg; 0 if it leads there.
    violation : float
        Sum of violated constraints on clearance, goal tolerance and lengths; 0 for a path that may
        be followed.
    cost : float
        Cost to be minimized.
    """

    length: float
    margin: float
    near_margin: float
    gentle_miss: float
    violation: float
    cost: float


@compiled
def required_clearance(
    length: float, uncertainty: PoseUncertainty, settings: PathSettings
) -> float:
    """Return the required clearance of a path's axis at a length from its beginning [m].

    The uncertainty of the pose displaces the needle until new tips are observed and the error is
    corrected: its weight decreases to 0 over `correction_length`.
    """
    weight = max(1.0 - length / settings.correction_length, 0.0)
    std = math.hypot(uncertainty.position_std, uncertainty.heading_std * length) * weight
    return settings.needle_radius + settings.sigmas * math.hypot(settings.tracking_std, std)


@compiled
def chain_margin(
    points: Array, count: int, table: Array, uncertainty: PoseUncertainty, settings: PathSettings
) -> float:
    """Return the least clearance of a polyline beyond the required one [m].

    Parameters
    ----------
    points : ndarray, shape (M, 4)
        Corners, and the path's length there; only the first `count` are used.
    count : int
        See `points`.
    table : ndarray, shape (N, 7)
        See `Obstacles`.
    uncertainty : PoseUncertainty
        Uncertainty of the pose at length 0.
    settings : PathSettings
        Requirements.
    """
    margin = math.inf
    for i in range(1, count):
        required = max(
            required_clearance(points[i - 1, 3], uncertainty, settings),
            required_clearance(points[i, 3], uncertainty, settings),
        )
        for k in range(table.shape[0]):
            distance = segment_distance(points[i - 1], points[i], table[k], table[k, 3:])
            margin = min(margin, distance - table[k, 6] - required)
    return margin


@compiled
def evaluate_path(legs: Array, problem: PathProblem, shortest: float) -> PathEvaluation:
    """Return the evaluation of a path.

    Parameters
    ----------
    legs : ndarray, shape (M, 4), changed
        Aim of each leg, the target last, and its largest length [m], which is replaced by its
        length.
    problem : PathProblem
        Task of the path.
    shortest : float
        Least length of a leg to a via point [m].
    """
    settings, table, known = problem.settings, problem.table, PoseUncertainty(0.0, 0.0)
    share = settings.gentle_share / settings.curvature_share
    pose, end, points = problem.start.copy(), np.empty((3, 4)), np.empty((MOST_POINTS, 4))
    length, margin, near_margin, miss, gentle, short = 0.0, math.inf, math.inf, 0.0, 0.0, 0.0
    for i in range(legs.shape[0]):
        kappa = problem.curvature
        leg = leg_towards(pose, legs[i], kappa, share, settings.max_rotation_per_length)
        leg = truncated(leg, legs[i, 3])
        count = trace_leg(pose, leg, kappa, length, points, end)
        margin = min(margin, chain_margin(points, count, table, problem.uncertainty, settings))
        near = 1
        while near < count and points[near, 3] <= settings.committed_length:
            near += 1
        near_margin = min(near_margin, chain_margin(points, near, table, known, settings))
        miss, gentle = leg.miss, leg.gentle_miss
        legs[i, 3] = leg_length(leg)
        length += legs[i, 3]
        if i + 1 < legs.shape[0]:
            short += max(shortest - legs[i, 3], 0.0)
        pose, end = end, pose
    # With a+ = max(a, 0): J = length + p_c (preferred_margin - margin)+ + p_m gentle_miss + p_v v,
    # v = (-margin)+ + (miss - tolerance)+ + (length - reach)+ + sum (shortest - length of a leg)+.
    violation = max(-margin, 0.0) + max(miss - settings.goal_tolerance, 0.0)
    violation += max(length - problem.reach, 0.0) + short
    cost = length + _MARGIN_PRICE * max(settings.preferred_margin - margin, 0.0)
    cost += _MISS_PRICE * gentle + _VIOLATION_PRICE * violation
    return PathEvaluation(length, margin, near_margin, gentle, violation, cost)
