"""Path to a point, and the turn of the bevel for it; compiled. See `point_law`."""

# Compiled code handles keyword arguments slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from needle_controller.model.arrays import Array, Records
from needle_core.compiled import compiled

_BEVEL = -0.5 * math.pi
"""Direction in which a needle bends, about its heading from its x axis [rad]: -y."""
_NO_TURN = 1e-6


class PointLawSettings(NamedTuple):
    """Settings of the point law.

    Attributes
    ----------
    step_length : float
        Inserted length per command [m].
    max_rotation_per_length : float
        Maximum rotation of the base per inserted length [rad/m].
    max_winding : float
        Limit of the base's angle in both directions; beyond it, the base turns in the other
        direction [rad].
    reserve : float
        Share of the curvature kept in reserve: the bevel turns to the target before the arc to it
        needs the rest. A smaller reserve means fewer turns, and less room to correct errors.
    doubt : float
        Number of standard deviations of the needed curvature that are added to it.
    last_turn : float
        Remaining insertion at which reserve and doubt are 0: no later turn can correct an error
        [m].
    last_turns_from : float
        Remaining insertion at which both begin to shrink [m].
    close_enough : float
        Dead band of the miss [m], at least half the standard deviation of the tip at the target.
    dead_band : float
        Dead band of the bevel's direction [rad].
    scatter_dead_band : float
        Increase of `dead_band` for a hypothesis whose rolls do not agree at all; proportional to
        1 - agreement [rad].
    largest_turn : float
        Largest turn of a single hypothesis per step, before averaging [rad].
    smallest_weight : float
        Hypotheses with a weight below this share of the largest are ignored.
    """

    step_length: float = 0.001
    max_rotation_per_length: float = math.radians(30.0) / 0.001
    max_winding: float = 6.0 * math.pi
    reserve: float = 0.4
    doubt: float = 2.0
    last_turn: float = 0.010
    last_turns_from: float = 0.03
    close_enough: float = 0.00005
    dead_band: float = 0.3
    scatter_dead_band: float = 2.0
    largest_turn: float = 2.0
    smallest_weight: float = 0.02


@compiled
def write_lateral_offset(target: Array, need: Array) -> float:
    """Write the lateral offset that the arc to a target has to cover; return its length [m].

    The arc may have any curvature. For a target next to or behind the tip, the length is the
    distance ahead, <= 0.

    Parameters
    ----------
    target : ndarray, shape (3,)
        Target in the frame of the tip [m].
    need : ndarray, shape (2,), written
        Offset along x and y of the tip: half the curvature of the arc times its length squared,
        which is the offset of the target from the heading if the arc is short [m].
    """
    across = math.hypot(target[0], target[1])
    need[:] = 0.0
    if target[2] <= 0.0 or across == 0.0:
        return float(target[2])
    square = across * across + target[2] * target[2]
    angle = math.atan2(across, target[2])
    length = math.sqrt(square) * angle / math.sin(angle)
    # The arc's curvature is 2 across / square.
    for i in range(2):
        need[i] = target[i] * (length * length / square)
    return length


@compiled
def insertion_to_closest_point(target: Array, arc_length: float, curvature: float) -> float:
    """Return the insertion until the needle is closest to a target [m].

    If no arc of the needle leads there, this is the closest point of the tightest arc.

    Parameters
    ----------
    target : ndarray, shape (3,)
        Target in the frame of the tip [m].
    arc_length : float
        Length of the arc to it, see `write_lateral_offset` [m].
    curvature : float
        Curvature of the needle's path [1/m].
    """
    across = math.hypot(target[0], target[1])
    square = across * across + target[2] * target[2]
    if target[2] <= 0.0 or 2.0 * across <= curvature * square:
        return arc_length
    return math.atan2(target[2], 1.0 / curvature - across) / curvature


@compiled
def mean_slack(torsions: Records, rate: float) -> float:
    """Return the insertion by which torsion of the shaft prolongs a turn of the tip [m].

    A lag adds its length, and play the insertion in which the base turns through it.

    Parameters
    ----------
    torsions : ndarray of TORSION, shape (K,)
        See `Hypotheses`.
    rate : float
        Maximum rotation of the base per inserted length [rad/m].
    """
    slack = weights = 0.0
    for k in range(torsions.size):
        t = torsions[k]
        slack += t.weight * (t.lag + t.play / rate)
        weights += t.weight
    return slack / weights


@compiled
def desired_turn(
    need: Array,
    left: float,
    curvature: float,
    std: float,
    slack: float,
    rotation_left: float,
    settings: PointLawSettings,
) -> float:
    """Return the turn of the tip towards the target [rad], or 0 if it can wait.

    Parameters
    ----------
    need : ndarray, shape (2,)
        See `write_lateral_offset` [m].
    left : float
        Remaining insertion, > 0 [m].
    curvature : float
        Curvature of the needle's path [1/m].
    std : float
        Standard deviation of the tip at the target, across its heading [m].
    slack : float
        See `mean_slack` [m].
    rotation_left : float
        See `point_turn` [rad].
    settings : PointLawSettings
        The settings.
    """
    rate = settings.max_rotation_per_length
    turn = turn_to(need)
    missed = rest_after(need, left, curvature, 0.0, left)
    close = math.hypot(missed[0], missed[1]) < max(settings.close_enough, 0.5 * std)
    if close or abs(turn) < settings.dead_band:
        return 0.0
    turning = abs(turn) / rate + slack
    if turning >= left:
        return better_end(need, left, curvature, abs(turn) / turning)
    # Can the turn wait for a step and still leave the reserve?
    later = left - settings.step_length
    if later <= 0.0:
        return turn
    need_then = np.array(rest_after(need, left, curvature, 0.0, settings.step_length))
    turn_then = turn_to(need_then)
    turning = abs(turn_then) / rate + slack
    straight = later - turning
    if straight <= 0.0:
        return turn
    rest = rest_after(need_then, later, curvature, turn_then / turning, turning)
    share_then = math.hypot(rest[0], rest[1]) / (0.5 * curvature * straight * straight)
    early = (left - settings.last_turn) / (settings.last_turns_from - settings.last_turn)
    early = min(max(early, 0.0), 1.0)
    # As a share of the offset that full curvature covers.
    unsure = std / (0.5 * curvature * left * left)
    kept = early * (settings.reserve + settings.doubt * unsure)
    kept = min(kept, affordable_reserve(left, rotation_left - abs(turn), settings.last_turn))
    return 0.0 if share_then + kept < 1.0 else turn


@compiled
def affordable_reserve(left: float, rotation_left: float, last_turn: float) -> float:
    """Return the reserve whose number of turns fits the rotation budget.

    With a reserve r, the needle bends to the target and equally far past that direction: the
    remaining insertion falls by the factor sqrt(r / (2 - r)) from one half turn to the next. The
    affordable half turns must reach the last turn.

    Parameters
    ----------
    left, last_turn : float
        Remaining insertion, now and at the last turn [m].
    rotation_left : float
        Rotation budget after the present turn [rad].
    """
    half_turns = rotation_left / math.pi
    if half_turns <= 0.0 or left <= last_turn:
        return 0.0
    square = (last_turn / left) ** (2.0 / half_turns)
    return float(2.0 * square / (1.0 + square))


@compiled
def turn_to(need: Array) -> float:
    """Return the turn that points the bevel towards a needed offset, in +-pi [rad]."""
    turn = math.atan2(need[1], need[0]) - _BEVEL
    return float((turn + math.pi) % (2.0 * math.pi) - math.pi)


@compiled
def rest_after(
    need: Array, left: float, curvature: float, rate: float, length: float
) -> tuple[float, float]:
    """Return the needed offset that remains after a length at a constant rotation rate, (2,) [m].

    To first order: with u the direction of the bevel, the integral of curvature u(s) (left - s) ds.

    Parameters
    ----------
    need : ndarray, shape (2,)
        See `write_lateral_offset` [m].
    left, curvature : float
        Remaining insertion [m], curvature of the needle's path [1/m].
    rate : float
        Rotation of the tip per inserted length [rad/m].
    length : float
        Inserted length, <= left [m].
    """
    rest = left - length
    if abs(rate * length) < _NO_TURN:
        along = 0.5 * curvature * (left * left - rest * rest)
        return need[0] - along * math.cos(_BEVEL), need[1] - along * math.sin(_BEVEL)
    end = _BEVEL + rate * length
    x = (rest * math.sin(end) - left * math.sin(_BEVEL)) / rate
    x -= (math.cos(end) - math.cos(_BEVEL)) / (rate * rate)
    y = (left * math.cos(_BEVEL) - rest * math.cos(end)) / rate
    y -= (math.sin(end) - math.sin(_BEVEL)) / (rate * rate)
    return need[0] - curvature * x, need[1] - curvature * y


@compiled
def better_end(need: Array, left: float, curvature: float, rate: float) -> float:
    """Return a quarter turn to the side that ends closer to the target, or 0 [rad].

    For a target that is too near for the whole turn; no turn may be better.
    """
    best = 0.0
    missed = rest_after(need, left, curvature, 0.0, left)
    nearest = math.hypot(missed[0], missed[1])
    for side in (-1.0, 1.0):
        missed = rest_after(need, left, curvature, side * rate, left)
        distance = math.hypot(missed[0], missed[1])
        if distance < nearest:
            nearest, best = distance, side * 0.5 * math.pi
    return best
