"""The roll law's arithmetic for many needles, compiled; see `roll_law`."""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from needle_common.compiled import compiled
from needle_controller.bank.hypothesis_mixture import (
    T_AGREEMENT,
    T_BEHIND_PLAY,
    T_CURVATURE,
    T_LAG,
    T_PLAY,
    T_ROLL,
    T_TIP_ANGLE,
    T_WEIGHT,
)
from needle_controller.model.arrays import Array

_SMALLEST_LAG = 1e-6
_USUAL_LAG = 0.008
_USUAL_PLAY = math.radians(40.0)


class RollLawNumbers(NamedTuple):
    """`RollLawSettings` for the compiled code."""

    step_length: float
    max_rotation_per_length: float
    max_winding: float
    plane_gain: float
    pitch_gain: float
    braking_share: float
    braking_share_added: float
    braking_from: float
    braking_over: float
    lag_caution: float
    braking_caution: float
    doubt: float
    scatter_dead_band: float
    near: float
    near_dead_band: float
    far_dead_band: float
    largest_turn: float
    smallest_weight: float


@compiled
def roll_turns(
    state: Array,
    table: Array,
    base: Array,
    wound: Array,
    bend_sign: Array,
    uncertainty: Array,
    numbers: RollLawNumbers,
    turn: Array,
    wanted: Array,
) -> None:
    """Write each needle's turn of the base over the next step [rad] and its wanted s3 [1/m].

    Parameters
    ----------
    state : ndarray, shape (N, 2)
        x [m] and sin(pitch), over all hypotheses.
    table : ndarray, shape (N, K, 8)
        See `Hypotheses`; likewise `base` and `wound`, shape (N,).
    bend_sign : ndarray, shape (N,)
        Wanted sign of cos(roll); 0 is either.
    uncertainty : ndarray, shape (N, 3)
        See `Hypotheses`.
    numbers : RollLawNumbers
        The settings.
    turn, wanted : ndarray, shape (N,), written
        The results.
    """
    limit = numbers.max_rotation_per_length * numbers.step_length
    for n in range(table.shape[0]):
        x, pitch = state[n, 0], state[n, 1]
        heaviest = np.max(table[n, :, T_WEIGHT])
        turns = weights = s3_mean = 0.0
        for k in range(table.shape[1]):
            row = table[n, k]
            if row[T_WEIGHT] < numbers.smallest_weight * heaviest or row[T_WEIGHT] == 0.0:
                continue
            weight = row[T_WEIGHT]
            s3, sine = wanted_bend(x, pitch, uncertainty[n], row, numbers)
            tip_turn = nearest_turn(row[T_ROLL], sine, bend_sign[n], wound[n], numbers.max_winding)
            dead_band = numbers.near_dead_band
            if abs(x) > numbers.near:
                dead_band = numbers.far_dead_band
            dead_band += numbers.scatter_dead_band * (1.0 - row[T_AGREEMENT])
            if abs(tip_turn) < dead_band:
                tip_turn = 0.0
            asked = base_turn(row, tip_turn, base[n], numbers.step_length)
            turns += weight * min(max(asked, -numbers.largest_turn), numbers.largest_turn)
            s3_mean += weight * s3
            weights += weight
        turn[n] = min(max(turns / weights, -limit), limit)
        wanted[n] = s3_mean / weights


@compiled
def wanted_bend(
    x: float, sin_pitch: float, uncertainty: Array, row: Array, numbers: RollLawNumbers
) -> tuple[float, float]:
    """Return the wanted s3 [1/m] and the sine of the roll that has it.

    Parameters
    ----------
    x, sin_pitch : float
        Distance from the plane [m] and sine of the pitch, over all hypotheses.
    uncertainty : ndarray, shape (3,)
        Of both, see `Hypotheses`.
    row : ndarray, shape (8,)
        A hypothesis, see `Hypotheses`.
    numbers : RollLawNumbers
        The settings.
    """
    curvature = row[T_CURVATURE]
    lag = min(row[T_LAG] / _USUAL_LAG, 1.0)
    caution = 1.0 - numbers.lag_caution * lag
    distance = abs(x)
    far = min(max((distance - numbers.braking_from) / numbers.braking_over, 0.0), 1.0)
    share = numbers.braking_share + numbers.braking_share_added * far
    share *= 1.0 - numbers.braking_caution * min(lag + row[T_PLAY] / _USUAL_PLAY, 1.0)
    # Level out on an arc of curvature share kappa: sin(pitch)^2 = 2 share kappa distance.
    steepest = math.sqrt(2.0 * share * curvature * distance)
    slope = numbers.plane_gain * caution
    descent = slope * distance
    if descent > steepest:
        descent = steepest
        slope = 0.5 * steepest / distance
    wanted_pitch = -descent if x > 0.0 else descent
    steerable = curvature * math.sqrt(max(1e-6, 1.0 - sin_pitch * sin_pitch))
    gain = numbers.pitch_gain * caution
    variance = uncertainty[2] + slope * (2.0 * uncertainty[1] + slope * uncertainty[0])
    # Standard deviation of the demand as a share of what steering can do.
    doubt = gain / steerable * math.sqrt(max(variance, 0.0))
    gain /= math.sqrt(1.0 + (numbers.doubt * doubt) ** 2)
    s3 = gain * (wanted_pitch - sin_pitch)
    s3 = min(max(s3, -steerable), steerable)
    return s3, min(max(s3 / steerable, -1.0), 1.0)


@compiled
def nearest_turn(
    roll: float, sine: float, bend_sign: float, wound: float, max_winding: float
) -> float:
    """Return the turn [rad] to a roll of a given sine that the winding allows.

    Parameters
    ----------
    roll : float
        Of the tip now [rad].
    sine : float
        Of the wanted roll.
    bend_sign : float
        Wanted sign of its cosine; 0 is either.
    wound : float
        Angle of the base [rad].
    max_winding : float
        What its size is kept to [rad]; if no way does that, it is the way that unwinds.
    """
    upright = math.asin(sine)
    best = cheapest = math.inf
    for side in range(2):
        if bend_sign > 0.0 and side == 1:
            continue
        if bend_sign < 0.0 and side == 0:
            continue
        wanted = upright if side == 0 else math.pi - upright
        turn = (wanted - roll + math.pi) % (2.0 * math.pi) - math.pi
        for way in range(2):
            if way == 1:
                turn -= math.copysign(2.0 * math.pi, turn)
            cost = abs(turn)
            over = abs(wound + turn) - max_winding
            if over > 0.0:
                cost += 10.0 + over
            if cost < cheapest:
                best, cheapest = turn, cost
    return best


@compiled
def base_turn(row: Array, tip_turn: float, base: float, length: float) -> float:
    """Return how far the base has to turn over a step for the tip to turn by `tip_turn` [rad].

    Parameters
    ----------
    row : ndarray, shape (8,)
        A hypothesis, see `Hypotheses`.
    tip_turn : float
        Wanted turn of the tip [rad]; 0 asks for no motion of it.
    base : float
        Rotation of the base since the start [rad].
    length : float
        Inserted length of the step [m].
    """
    tip, behind, play, lag = row[T_TIP_ANGLE], row[T_BEHIND_PLAY], row[T_PLAY], row[T_LAG]
    if lag > _SMALLEST_LAG:
        # The tip goes this share of the way to the angle behind the play in one step.
        goal = tip + tip_turn / (1.0 - math.exp(-length / lag))
    elif tip_turn == 0.0:
        goal = behind
    else:
        goal = tip + tip_turn
    change = goal - behind
    if abs(change) < 1e-9:
        return 0.0
    return float(goal + math.copysign(play, change) - base)
