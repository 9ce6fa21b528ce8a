"""The law of preset `best`: what roll takes the needle to the plane, and the turn that gives it.

In the linearized state s of [KC09] (6), x and sin(pitch) are the mean over all hypotheses. Far from
the plane the wanted pitch is the steepest from which the needle can still level out with a share of
its curvature, near it a straight line through 0; the wanted s3 takes the pitch there, and the roll
is turned the nearest way to one of the two that have this s3. Every torsion then says which turn of
the base takes the tip there through its play and lag; the turns are averaged by weight.
"""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import math
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from needle_controller.filter.records import TORSION
from needle_controller.laws.law import SteeringCommand
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import PITCH, ROLL, X
from needle_controller.observers.estimator import Estimate, Hypotheses
from needle_core.compiled import compiled
from needle_core.settings.bounds import Bounds, check_bounded_fields

Records = npt.NDArray[np.void]

_SMALLEST_LAG = 1e-6
_USUAL_LAG = 0.008
_USUAL_PLAY = math.radians(40.0)


class RollLawSettings(NamedTuple):
    """Settings of the roll law.

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
    scatter_dead_band : float
        What is added to the dead band where the hypotheses' rolls point everywhere, in proportion
        to how little they agree: a needle that is left alone shows its roll soonest [rad].
    near : float
        Distance from the plane within which `near_dead_band` holds [m].
    near_dead_band, far_dead_band : float
        Errors of the roll that are left alone, which saves rotation [rad].
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
    plane_gain: Annotated[float, Bounds(0.0, 1e5, "1/m")] = 150.0
    pitch_gain: Annotated[float, Bounds(0.0, 1e5, "1/m")] = 200.0
    braking_share: Annotated[float, Bounds(0.01, 2.0, "-")] = 0.5
    braking_share_added: Annotated[float, Bounds(0.0, 2.0, "-")] = 0.5
    braking_from: Annotated[float, Bounds(0.0, 1.0, "m")] = 0.0025
    braking_over: Annotated[float, Bounds(1e-6, 1.0, "m")] = 0.003
    lag_caution: Annotated[float, Bounds(0.0, 1.0, "-")] = 0.45
    braking_caution: Annotated[float, Bounds(0.0, 1.0, "-")] = 0.5
    doubt: Annotated[float, Bounds(0.0, 10.0, "-")] = 0.4
    scatter_dead_band: Annotated[float, Bounds(0.0, math.pi, "rad")] = 1.0
    near: Annotated[float, Bounds(0.0, 1.0, "m")] = 0.0005
    near_dead_band: Annotated[float, Bounds(0.0, math.pi, "rad")] = 0.35
    far_dead_band: Annotated[float, Bounds(0.0, math.pi, "rad")] = 0.2
    largest_turn: Annotated[float, Bounds(0.01, 100.0, "rad")] = 2.0
    smallest_weight: Annotated[float, Bounds(0.0, 1.0, "-")] = 0.02


class RollLaw:
    """Turns the base to the roll that takes the needle to the plane.

    Parameters
    ----------
    settings : RollLawSettings
        Gains and limits.

    Raises
    ------
    OutOfBoundsError
        A setting that is outside its bounds.
    """

    def __init__(self, settings: RollLawSettings) -> None:
        check_bounded_fields(settings)
        self.settings = settings

    def __call__(self, estimate: Estimate, bend_sign: float = 0.0) -> SteeringCommand:
        """Return the rotation rate to hold over the next step.

        Parameters
        ----------
        estimate : Estimate
            Of the hypothesis filter, or of any other estimator: then as one hypothesis without
            torsion.
        bend_sign : float
            Wanted sign of cos(roll), which says to what side the needle bends within the plane; 0
            leaves it to what is nearest. A change of sign is a turn by pi - 2 roll, which keeps the
            curvature out of the plane.
        """
        known, s = hypotheses_of(estimate), estimate.linearized
        turn, wanted = roll_turn(
            float(s[0]),
            float(s[1]),
            known.uncertainty,
            known.torsions,
            known.base,
            known.wound,
            float(bend_sign),
            self.settings,
        )
        length = self.settings.step_length
        return SteeringCommand((wanted - float(s[2])) / length, turn / length)


def hypotheses_of(estimate: Estimate) -> Hypotheses:
    """Return an estimate's hypotheses: those behind a mixture, else the estimate as the only one.

    Without a bank the winding of the base is not known and counts as 0.
    """
    if estimate.hypotheses is not None:
        return estimate.hypotheses
    only = np.zeros(1, TORSION)
    only["roll"], only["curvature"] = estimate.coordinates[ROLL], estimate.curvature
    only["agreement"] = only["weight"] = only["gain"] = 1.0
    covariance, cosine = estimate.covariance, math.cos(float(estimate.coordinates[PITCH]))
    # d sin(pitch) = cos(pitch) dpitch
    uncertainty = np.array(
        [covariance[X, X], covariance[X, PITCH] * cosine, covariance[PITCH, PITCH] * cosine**2]
    )
    return Hypotheses(only, 0.0, 0.0, uncertainty)


@compiled
def roll_turn(
    x: float,
    sin_pitch: float,
    uncertainty: Array,
    torsions: Records,
    base: float,
    wound: float,
    bend_sign: float,
    settings: RollLawSettings,
) -> tuple[float, float]:
    """Return the turn of the base over the next step [rad] and the wanted s3 [1/m].

    Parameters
    ----------
    x, sin_pitch : float
        Distance from the plane [m] and sine of the pitch, over all hypotheses.
    uncertainty, torsions, base, wound :
        See `Hypotheses`.
    bend_sign : float
        Wanted sign of cos(roll); 0 is either.
    settings : RollLawSettings
        The settings.
    """
    limit = settings.max_rotation_per_length * settings.step_length
    least = settings.smallest_weight * heaviest(torsions)
    turns = weights = s3_mean = 0.0
    for k in range(torsions.size):
        t = torsions[k]
        if t.weight < least or t.weight == 0.0:
            continue
        s3, sine = wanted_bend(x, sin_pitch, uncertainty, t, settings)
        tip_turn = nearest_turn(t.roll, sine, bend_sign, wound, settings.max_winding)
        dead_band = settings.far_dead_band if abs(x) > settings.near else settings.near_dead_band
        dead_band += settings.scatter_dead_band * (1.0 - t.agreement)
        if abs(tip_turn) < dead_band:
            tip_turn = 0.0
        asked = base_turn(t, tip_turn, base, settings.step_length)
        turns += t.weight * min(max(asked, -settings.largest_turn), settings.largest_turn)
        s3_mean += t.weight * s3
        weights += t.weight
    return min(max(turns / weights, -limit), limit), s3_mean / weights


@compiled
def heaviest(torsions: Records) -> float:
    """Return the largest weight."""
    largest = 0.0
    for k in range(torsions.size):
        largest = max(largest, torsions[k].weight)
    return largest


@compiled
def wanted_bend(
    x: float, sin_pitch: float, uncertainty: Array, t: Any, settings: RollLawSettings
) -> tuple[float, float]:
    """Return the wanted s3 [1/m] and the sine of the roll that has it.

    Parameters
    ----------
    x, sin_pitch : float
        Distance from the plane [m] and sine of the pitch, over all hypotheses.
    uncertainty : ndarray, shape (3,)
        Of both, see `Hypotheses`.
    t : TORSION
        A torsion.
    settings : RollLawSettings
        The settings.
    """
    lag = min(t.lag / _USUAL_LAG, 1.0)
    caution = 1.0 - settings.lag_caution * lag
    distance = abs(x)
    far = min(max((distance - settings.braking_from) / settings.braking_over, 0.0), 1.0)
    share = settings.braking_share + settings.braking_share_added * far
    share *= 1.0 - settings.braking_caution * min(lag + t.play / _USUAL_PLAY, 1.0)
    # Level out on an arc of curvature share kappa: sin(pitch)^2 = 2 share kappa distance.
    steepest = math.sqrt(2.0 * share * t.curvature * distance)
    slope = settings.plane_gain * caution
    descent = slope * distance
    if descent > steepest:
        descent = steepest
        slope = 0.5 * steepest / distance
    wanted_pitch = -descent if x > 0.0 else descent
    steerable = t.curvature * math.sqrt(max(1e-6, 1.0 - sin_pitch * sin_pitch))
    gain = settings.pitch_gain * caution
    # Standard deviation of the demand as a share of what steering can do.
    variance = uncertainty[2] + slope * (2.0 * uncertainty[1] + slope * uncertainty[0])
    doubt = gain / steerable * math.sqrt(max(variance, 0.0))
    gain /= math.sqrt(1.0 + (settings.doubt * doubt) ** 2)
    # s3 = gain (wanted sin(pitch) - sin(pitch)), as far as the needle bends
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
        turn, cost = allowed_turn(wanted - roll, wound, max_winding)
        if cost < cheapest:
            best, cheapest = turn, cost
    return best


@compiled
def allowed_turn(turn: float, wound: float, max_winding: float) -> tuple[float, float]:
    """Return the shorter way to an angle that the winding allows, and its cost [rad].

    Parameters
    ----------
    turn : float
        To the angle, by any way [rad].
    wound, max_winding : float
        See `nearest_turn`.
    """
    way = (turn + math.pi) % (2.0 * math.pi) - math.pi
    best = cheapest = math.inf
    for k in range(2):
        if k == 1:
            way -= math.copysign(2.0 * math.pi, way)
        cost = abs(way)
        over = abs(wound + way) - max_winding
        if over > 0.0:
            cost += 10.0 + over
        if cost < cheapest:
            best, cheapest = way, cost
    return best, cheapest


@compiled
def base_turn(t: Any, tip_turn: float, base: float, length: float) -> float:
    """Return how far the base has to turn over a step for the tip to turn by `tip_turn` [rad].

    Parameters
    ----------
    t : TORSION
        A torsion.
    tip_turn : float
        Wanted turn of the tip [rad]; 0 asks for no motion of it.
    base : float
        Rotation of the base since the start [rad].
    length : float
        Inserted length of the step [m].
    """
    if t.lag > _SMALLEST_LAG:
        # The tip goes this share of the way to the angle behind the play in one step.
        goal = t.tip_angle + tip_turn / (1.0 - math.exp(-length / t.lag))
    elif tip_turn == 0.0:
        goal = t.behind_play
    else:
        goal = t.tip_angle + tip_turn
    change = goal - t.behind_play
    if abs(change) < 1e-9:
        return 0.0
    return float((goal + math.copysign(t.play, change)) / t.gain - base)
