"""The way to a point, and when the bevel has to be turned for it; compiled. See `point_law`."""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_core.compiled import compiled
from needle_core.settings.bounds import Bounds

Records = npt.NDArray[np.void]

_BEVEL = -0.5 * math.pi
"""Direction to which a needle bends, about its heading from its own x axis [rad]: -y."""
_NO_TURN = 1e-6


class PointLawSettings(NamedTuple):
    """Settings of the point law.

    Attributes
    ----------
    step_length : float
        Inserted length over which a command is held [m].
    max_rotation_per_length : float
        Most the base turns per inserted length [rad/m].
    max_winding : float
        The base's angle is kept within +- this: the turn then goes the other way round [rad].
    reserve : float
        Share of the curvature that is kept back: the bevel is turned to the target no later than
        when the way there takes the rest. Less means fewer turns, and less to make up for errors.
    doubt : float
        Standard deviations of that need that count as need.
    last_turn : float
        Insertion left at which reserve and doubt are 0: what is unknown then cannot be made up for
        by another turn [m].
    last_turns_from : float
        Insertion left from which they shrink to that [m].
    close_enough : float
        A miss that is left alone [m]; so is half a standard deviation of where the tip would be at
        the target.
    dead_band : float
        An error of the bevel's direction that is left alone [rad].
    scatter_dead_band : float
        What is added to it where the hypotheses' rolls point everywhere, in proportion to how
        little they agree [rad].
    largest_turn : float
        Most that a single hypothesis asks of a step, before the mean [rad].
    smallest_weight : float
        Hypotheses that weigh less than this share of the heaviest have no say in the turn.
    """

    step_length: Annotated[float, Bounds(1e-5, 0.1, "m")] = 0.001
    max_rotation_per_length: Annotated[float, Bounds(0.0, 1e5, "rad/m")] = (
        math.radians(30.0) / 0.001
    )
    max_winding: Annotated[float, Bounds(2.0 * math.pi, 1e6, "rad")] = 6.0 * math.pi
    reserve: Annotated[float, Bounds(0.0, 1.0, "-")] = 0.4
    doubt: Annotated[float, Bounds(0.0, 10.0, "-")] = 2.0
    last_turn: Annotated[float, Bounds(0.0, 1.0, "m")] = 0.010
    last_turns_from: Annotated[float, Bounds(0.0, 1.0, "m")] = 0.03
    close_enough: Annotated[float, Bounds(0.0, 1.0, "m")] = 0.00005
    dead_band: Annotated[float, Bounds(0.0, math.pi, "rad")] = 0.3
    scatter_dead_band: Annotated[float, Bounds(0.0, math.pi, "rad")] = 2.0
    largest_turn: Annotated[float, Bounds(0.01, 100.0, "rad")] = 2.0
    smallest_weight: Annotated[float, Bounds(0.0, 1.0, "-")] = 0.02


@compiled
def write_need(target: Array, need: Array) -> float:
    """Write how far the way to a target has to bend off, and return how long it is [m].

    The way is an arc, of whatever curvature leads there. A target beside or behind the tip is as
    near as it gets: the length is then what it lies ahead, <= 0.

    Parameters
    ----------
    target : ndarray, shape (3,)
        In the tip's frame [m].
    need : ndarray, shape (2,), written
        Along the tip's x and y: half the arc's curvature times its length squared, which is what
        the target lies off the heading where the arc is short [m].
    """
    across = math.hypot(target[0], target[1])
    need[:] = 0.0
    if target[2] <= 0.0 or across == 0.0:
        return float(target[2])
    square = across * across + target[2] * target[2]
    angle = math.atan2(across, target[2])
    length = math.sqrt(square) * angle / math.sin(angle)
    # The arc's curvature is 2 across / square.
    need[:] = target[:2] * (length * length / square)
    return length


@compiled
def way_as_bent(target: Array, way: float, curvature: float) -> float:
    """Return how far a needle has to go until it is as near to a target as it gets [m].

    Where no arc of the needle's leads there, that is where the tightest one comes nearest.

    Parameters
    ----------
    target : ndarray, shape (3,)
        In the tip's frame [m].
    way : float
        On the arc that leads there, see `write_need` [m].
    curvature : float
        Of the needle's path [1/m].
    """
    across = math.hypot(target[0], target[1])
    square = across * across + target[2] * target[2]
    if target[2] <= 0.0 or 2.0 * across <= curvature * square:
        return way
    return math.atan2(target[2], 1.0 / curvature - across) / curvature


@compiled
def mean_slack(torsions: Records, rate: float) -> float:
    """Return how much longer a turn of the tip takes for the shaft's torsion [m].

    A lag takes its length, and a play the insertion over which the base turns through it.

    Parameters
    ----------
    torsions : ndarray of TORSION, shape (K,)
        See `Hypotheses`.
    rate : float
        Most the base turns per inserted length [rad/m].
    """
    slack = weights = 0.0
    for k in range(torsions.size):
        t = torsions[k]
        slack += t.weight * (t.lag + t.play / rate)
        weights += t.weight
    return slack / weights


@compiled
def wanted_turn(
    need: Array,
    left: float,
    curvature: float,
    std: float,
    slack: float,
    rotation_left: float,
    settings: PointLawSettings,
) -> float:
    """Return the turn of the tip that leads it to the target [rad]; 0 where it is to be left alone.

    Parameters
    ----------
    need : ndarray, shape (2,)
        See `write_need` [m].
    left : float
        Insertion left, > 0 [m].
    curvature : float
        Of the needle's path [1/m].
    std : float
        Standard deviation of where the tip would be at the target, across its heading [m].
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
    # Whether it can wait for a step, and then still has what is kept back.
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
    # As a share of what bending all the way would do.
    unsure = std / (0.5 * curvature * left * left)
    kept = early * (settings.reserve + settings.doubt * unsure)
    kept = min(kept, affordable_reserve(left, rotation_left - abs(turn), settings.last_turn))
    return 0.0 if share_then + kept < 1.0 else turn


@compiled
def affordable_reserve(left: float, rotation_left: float, last_turn: float) -> float:
    """Return the share of the curvature that can be kept back without too many turns to come.

    With a share r kept back, the needle bends to the target and as far past that direction: what is
    left falls to sqrt(r / (2 - r)) of itself from one half turn to the next. So many half turns
    as can be made shall bring it to the last one.

    Parameters
    ----------
    left, last_turn : float
        Insertion left, now and at the last turn [m].
    rotation_left : float
        What the base may turn after the turn that is to be made now [rad].
    """
    half_turns = rotation_left / math.pi
    if half_turns <= 0.0 or left <= last_turn:
        return 0.0
    square = (last_turn / left) ** (2.0 / half_turns)
    return float(2.0 * square / (1.0 + square))


@compiled
def turn_to(need: Array) -> float:
    """Return the turn that brings the bevel's direction to that of a need, in +-pi [rad]."""
    turn = math.atan2(need[1], need[0]) - _BEVEL
    return float((turn + math.pi) % (2.0 * math.pi) - math.pi)


@compiled
def rest_after(
    need: Array, left: float, curvature: float, rate: float, length: float
) -> tuple[float, float]:
    """Return what is left of a need after a length at a constant rotation rate, (x, y) [m].

    To first order: with u the bevel's direction, curvature u(s) (left - s) ds adds up along it.

    Parameters
    ----------
    need : ndarray, shape (2,)
        See `write_need` [m].
    left, curvature : float
        Insertion left [m], curvature of the needle's path [1/m].
    rate : float
        Rotation of the tip per inserted length [rad/m].
    length : float
        Inserted, <= left [m].
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
    """Return a quarter turn to the side that ends nearer to the target, or 0 [rad].

    For where the target is too near for the whole turn to it: not to turn may be better.
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
