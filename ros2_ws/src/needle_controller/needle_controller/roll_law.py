"""The law of preset `best`: what roll takes the needle to the plane, and the turn that gives it.

In the linearized state s of [KC09] (6), x and sin(pitch) are the mean over all hypotheses. Far from
the plane the wanted pitch is the steepest from which the needle can still level out with a share of
its curvature, near it a straight line through 0; the wanted s3 takes the pitch there, and the roll
is turned the nearest way to one of the two that have this s3. Every hypothesis then says which turn
of the base takes the tip there through its own play and lag; the turns are averaged by weight.
"""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from needle_common.compiled import compiled
from needle_controller.arrays import Array
from needle_controller.estimator import Estimate
from needle_controller.hypotheses import bounded, check_bounded_fields
from needle_controller.hypothesis_mixture import (
    COLUMNS,
    T_BEHIND_PLAY,
    T_CURVATURE,
    T_KIND,
    T_LAG,
    T_PLAY,
    T_ROLL,
    T_SIN_PITCH,
    T_TIP_ANGLE,
    T_WEIGHT,
    T_X,
    Hypotheses,
    MixtureEstimate,
)
from needle_controller.kinematics import PITCH, ROLL, X
from needle_controller.law import Command

_SMALLEST_LAG = 1e-6
_USUAL_LAG = 0.008
_FULL_DOUBT = 4.0
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
    doubt_dead_band: float
    scatter_dead_band: float
    near: float
    near_dead_band: float
    far_dead_band: float
    largest_turn: float
    smallest_weight: float
    weight_exponent: float


@dataclasses.dataclass(frozen=True)
class RollLawSettings:
    """What the roll law is made of.

    Attributes
    ----------
    step_length : float
        Inserted length over which a command is held [m].
    max_rotation_per_length : float
        Most the base turns per inserted length [rad/m].
    max_winding : float
        The base's angle is kept within +- this: the turn then goes the other way round [rad].
    plane_gain : float
        Wanted sin(pitch) per distance from the plane, near it [1/m].
    pitch_gain : float
        Wanted s3 per error of sin(pitch) [1/m].
    braking_share : float
        Share of the curvature that the approach counts on for levelling out.
    braking_share_added : float
        What is added to it far from the plane.
    braking_from, braking_over : float
        Distance at which that begins, and over which it grows to the whole [m].
    lag_caution : float
        Share by which both gains are lowered at a lag of 8 mm.
    braking_caution : float
        Share by which the braking share is lowered at a lag of 8 mm or a play of 40 deg.
    doubt : float
        How much the demand on s3 shrinks with the uncertainty of what it is made of: by 1 /
        sqrt(1 + (doubt std(s3 demand) / curvature)^2). Without it, a needle whose pitch is hardly
        known is spun to and fro, which hides its roll.
    doubt_dead_band : float
        What is added to the dead band while the doubt is large, in proportion to it [rad].
    scatter_dead_band : float
        What is added to it where the hypotheses' rolls point everywhere, in proportion to how
        little they agree: a needle that is left alone shows its roll soonest [rad].
    near : float
        Distance from the plane within which `near_dead_band` holds [m].
    near_dead_band, far_dead_band : float
        Errors of the roll that are left alone, which saves rotation [rad].
    largest_turn : float
        Most that a single hypothesis asks of a step, before the mean [rad].
    smallest_weight : float
        Hypotheses that weigh less than this share of the heaviest have no say in the turn.
    weight_exponent : float
        The turns are averaged by the weights to this power.
    """

    step_length: float = bounded(0.001, 1e-5, 0.1, "m")
    max_rotation_per_length: float = bounded(math.radians(30.0) / 0.001, 0.0, 1e5, "rad/m")
    max_winding: float = bounded(6.0 * math.pi, 2.0 * math.pi, 1e6, "rad")
    plane_gain: float = bounded(120.0, 0.0, 1e5, "1/m")
    pitch_gain: float = bounded(250.0, 0.0, 1e5, "1/m")
    braking_share: float = bounded(0.5, 0.01, 2.0, "-")
    braking_share_added: float = bounded(0.5, 0.0, 2.0, "-")
    braking_from: float = bounded(0.0025, 0.0, 1.0, "m")
    braking_over: float = bounded(0.003, 1e-6, 1.0, "m")
    lag_caution: float = bounded(0.45, 0.0, 1.0, "-")
    braking_caution: float = bounded(0.5, 0.0, 1.0, "-")
    doubt: float = bounded(1.0, 0.0, 10.0, "-")
    doubt_dead_band: float = bounded(0.0, 0.0, math.pi, "rad")
    scatter_dead_band: float = bounded(0.8, 0.0, math.pi, "rad")
    near: float = bounded(0.0005, 0.0, 1.0, "m")
    near_dead_band: float = bounded(0.25, 0.0, math.pi, "rad")
    far_dead_band: float = bounded(0.15, 0.0, math.pi, "rad")
    largest_turn: float = bounded(2.0, 0.01, 100.0, "rad")
    smallest_weight: float = bounded(0.02, 0.0, 1.0, "-")
    weight_exponent: float = bounded(1.0, 0.1, 10.0, "-")

    def __post_init__(self) -> None:
        """Check every field; raises UserError with the value and the bound."""
        check_bounded_fields(self)


class RollLaw:
    """Turns the base to the roll that takes the needle to the plane.

    Parameters
    ----------
    settings : RollLawSettings
        Gains and limits.
    """

    def __init__(self, settings: RollLawSettings) -> None:
        self.settings = settings
        self._numbers = RollLawNumbers(**dataclasses.asdict(settings))

    def __call__(self, estimate: Estimate, bend_sign: npt.ArrayLike = 0.0) -> Command:
        """Return the rotation rate to hold over the next step.

        Parameters
        ----------
        estimate : Estimate
            Of the hypothesis filter, or of any other estimator: then as one hypothesis without
            torsion.
        bend_sign : array_like, shape (...)
            Wanted sign of cos(roll), which says to what side the needle bends within the plane; 0
            leaves it to what is nearest. A change of sign is a turn by pi - 2 roll, which keeps the
            curvature out of the plane.
        """
        hypotheses = hypotheses_of(estimate)
        shape = hypotheses.base.shape
        rows = hypotheses.table.reshape(-1, *hypotheses.table.shape[-2:])
        turn, wanted = np.empty(len(rows)), np.empty(len(rows))
        sign = np.broadcast_to(np.asarray(bend_sign, dtype=float), shape)
        roll_turns(
            rows,
            np.ascontiguousarray(hypotheses.base.reshape(-1)),
            np.ascontiguousarray(hypotheses.wound.reshape(-1)),
            np.ascontiguousarray(sign.reshape(-1)),
            np.ascontiguousarray(hypotheses.uncertainty.reshape(-1, 3)),
            self._numbers,
            turn,
            wanted,
        )
        length = self.settings.step_length
        rate = turn.reshape(shape) / length
        virtual = (wanted.reshape(shape) - estimate.linearized[..., 2]) / length
        return Command(np.asarray(virtual), np.asarray(rate))


def hypotheses_of(estimate: Estimate) -> Hypotheses:
    """Return an estimate's hypotheses: those behind a mixture, else the estimate as the only one.

    Without a bank the winding of the base is not known and counts as 0.
    """
    if isinstance(estimate, MixtureEstimate):
        return estimate.hypotheses
    shape = estimate.coordinates.shape[:-1]
    table = np.zeros((*shape, 1, COLUMNS))
    table[..., 0, T_X] = estimate.coordinates[..., 0]
    table[..., 0, T_SIN_PITCH] = np.sin(estimate.reduced[..., 1])
    table[..., 0, T_ROLL] = estimate.coordinates[..., ROLL]
    table[..., 0, T_CURVATURE] = estimate.curvature
    table[..., 0, T_WEIGHT] = 1.0
    covariance = estimate.covariance
    cosine = np.cos(estimate.reduced[..., 1])
    uncertainty = np.stack(
        [
            covariance[..., X, X],
            covariance[..., X, PITCH] * cosine,
            covariance[..., PITCH, PITCH] * cosine**2,
        ],
        axis=-1,
    )
    return Hypotheses(table, np.zeros(shape), np.zeros(shape), uncertainty)


@compiled
def roll_turns(
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
    table : ndarray, shape (N, H, 10)
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
    means = np.empty((int(np.max(table[:, :, T_KIND])) + 1, 3))
    for n in range(table.shape[0]):
        x = pitch = heaviest = 0.0
        for h in range(table.shape[1]):
            weight = table[n, h, T_WEIGHT]
            x += weight * table[n, h, T_X]
            pitch += weight * table[n, h, T_SIN_PITCH]
            heaviest = max(heaviest, weight)
        mean_rolls(table[n], numbers.smallest_weight * heaviest, means)
        turns = weights = s3_mean = 0.0
        for h in range(table.shape[1]):
            row = table[n, h]
            if row[T_WEIGHT] < numbers.smallest_weight * heaviest or row[T_WEIGHT] == 0.0:
                continue
            weight = (row[T_WEIGHT] / heaviest) ** numbers.weight_exponent
            s3, sine, doubt = wanted_bend(x, pitch, uncertainty[n], row, numbers)
            roll, agreement = means[int(row[T_KIND]), 0], means[int(row[T_KIND]), 1]
            tip_turn = nearest_turn(roll, sine, bend_sign[n], wound[n], numbers.max_winding)
            dead_band = numbers.near_dead_band
            if abs(x) > numbers.near:
                dead_band = numbers.far_dead_band
            dead_band += numbers.scatter_dead_band * (1.0 - agreement)
            dead_band += numbers.doubt_dead_band * min(doubt / _FULL_DOUBT, 1.0)
            if abs(tip_turn) < dead_band:
                tip_turn = 0.0
            asked = base_turn(row, tip_turn, base[n], numbers.step_length)
            turns += weight * min(max(asked, -numbers.largest_turn), numbers.largest_turn)
            s3_mean += weight * s3
            weights += weight
        limit = numbers.max_rotation_per_length * numbers.step_length
        turn[n] = min(max(turns / weights, -limit), limit)
        wanted[n] = s3_mean / weights


@compiled
def mean_rolls(table: Array, smallest_weight: float, means: Array) -> None:
    """Write every torsion hypothesis's mean direction of roll [rad] and how its rolls agree: 0..1.

    Parameters
    ----------
    table : ndarray, shape (H, 10)
        One needle's hypotheses.
    smallest_weight : float
        What weighs less is left out.
    means : ndarray, shape (K, 3), written
        Roll, agreement, scratch.
    """
    means[:] = 0.0
    for h in range(table.shape[0]):
        weight = table[h, T_WEIGHT]
        if weight > 0.0 and weight >= smallest_weight:
            kind = int(table[h, T_KIND])
            means[kind, 0] += weight * math.cos(table[h, T_ROLL])
            means[kind, 1] += weight * math.sin(table[h, T_ROLL])
            means[kind, 2] += weight
    for kind in range(means.shape[0]):
        if means[kind, 2] > 0.0:
            along, across = means[kind, 0], means[kind, 1]
            means[kind, 0] = math.atan2(across, along)
            means[kind, 1] = math.sqrt(along * along + across * across) / means[kind, 2]


@compiled
def wanted_bend(
    x: float, sin_pitch: float, uncertainty: Array, row: Array, numbers: RollLawNumbers
) -> tuple[float, float, float]:
    """Return the wanted s3 [1/m], the sine of the roll that has it, and the doubt about it.

    The doubt is the standard deviation of the demand as a share of what steering can do.

    Parameters
    ----------
    x, sin_pitch : float
        Distance from the plane [m] and sine of the pitch, over all hypotheses.
    uncertainty : ndarray, shape (3,)
        Of both, see `Hypotheses`.
    row : ndarray, shape (10,)
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
    steerable = curvature * math.sqrt(max(1e-6, 1.0 - row[T_SIN_PITCH] ** 2))
    gain = numbers.pitch_gain * caution
    variance = uncertainty[2] + slope * (2.0 * uncertainty[1] + slope * uncertainty[0])
    doubt = gain / steerable * math.sqrt(max(variance, 0.0))
    gain /= math.sqrt(1.0 + (numbers.doubt * doubt) ** 2)
    s3 = gain * (wanted_pitch - sin_pitch)
    s3 = min(max(s3, -steerable), steerable)
    return s3, min(max(s3 / steerable, -1.0), 1.0), doubt


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
    row : ndarray, shape (10,)
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
