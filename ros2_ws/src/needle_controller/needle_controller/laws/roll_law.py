"""The law of preset `best`: the roll that leads to the plane, and the rotation of the base for it.

In the linearized state s of [KC09] (6), x and sin(pitch) are means over all hypotheses. Far from
the plane, the desired pitch is the steepest from which the needle can level out with a share of its
curvature; near it, it is proportional to the distance. The desired s3 brings the pitch to it, and
the tip takes the shorter turn to one of the two rolls that have this s3. Each torsion determines
the rotation of the base that turns the tip through play and lag; the mean over all torsions is
used.

Within the plane, the needle bends to the side given by the sign of cos(roll). Turning the bevel
over at planned depths makes it follow a path of arcs (Reed et al., Integrated planning and
image-guided control for planar needle steering, BioRob 2008), while the law keeps it in the plane.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from needle_controller.filter.records import ESTIMATE, TORSION
from needle_controller.laws.law import SteeringCommand
from needle_controller.model.arrays import Array, Records
from needle_controller.model.kinematics import PITCH, ROLL, X
from needle_controller.observers.estimator import Estimate, Hypotheses
from needle_core.compiled import compiled
from needle_core.errors import OutOfBoundsError, UserError

_SMALLEST_LAG = 1e-6
_USUAL_LAG = 0.008
_USUAL_PLAY = math.radians(40.0)
_DEPTH_TOLERANCE = 1e-6


class RollLawSettings(NamedTuple):
    """Settings of the roll law.

    Attributes
    ----------
    step_length : float
        Inserted length over which a command is held [m].
    max_rotation_per_length : float
        Largest rotation of the base per inserted length [rad/m].
    max_winding : float
        Largest absolute angle of the base; beyond it, the base turns in the other direction [rad].
    plane_gain : float
        Desired sin(pitch) per distance near the plane [1/m].
    pitch_gain : float
        Desired s3 per error of sin(pitch) [1/m].
    braking_share : float
        Share of the curvature that is planned for levelling out.
    braking_share_added : float
        Increase of this share far from the plane.
    braking_from, braking_over : float
        Distance at which the increase begins, and over which it becomes complete [m].
    lag_caution : float
        Relative reduction of both gains at a lag of 8 mm.
    braking_caution : float
        Relative reduction of the braking share at a lag of 8 mm or a play of 40 deg.
    uncertainty_weight : float
        Reduction of the desired s3 by its uncertainty, by 1 / sqrt(1 + (weight std(s3) /
        curvature)^2). Without it, a needle with an uncertain pitch would be turned back and forth,
        which hides its roll.
    scatter_dead_band : float
        Increase of the dead band in proportion to the disagreement of the hypotheses' rolls: a
        needle that is not turned reveals its roll soonest [rad].
    near : float
        Distance from the plane within which `near_dead_band` holds [m].
    near_dead_band, far_dead_band : float
        Largest errors of the roll that are not corrected, which saves rotation [rad].
    largest_turn : float
        Largest rotation for a single torsion in one step, before averaging [rad].
    smallest_weight : float
        Torsions with a smaller weight, relative to the heaviest, are ignored.
    """

    step_length: float = 0.001
    max_rotation_per_length: float = math.radians(30.0) / 0.001
    max_winding: float = 6.0 * math.pi
    plane_gain: float = 150.0
    pitch_gain: float = 200.0
    braking_share: float = 0.5
    braking_share_added: float = 0.5
    braking_from: float = 0.0025
    braking_over: float = 0.003
    lag_caution: float = 0.45
    braking_caution: float = 0.5
    uncertainty_weight: float = 0.4
    scatter_dead_band: float = 1.0
    near: float = 0.0005
    near_dead_band: float = 0.35
    far_dead_band: float = 0.2
    largest_turn: float = 2.0
    smallest_weight: float = 0.02


def check_flips(depths: Sequence[float], end: float) -> None:
    """Check that flips come in increasing order, above 0 and before the end of steering.

    Parameters
    ----------
    depths : sequence of float
        Insertion depths of the flips [m].
    end : float
        Insertion at which steering ends [m].

    Raises
    ------
    UserError
        Depths that are not above 0 or not increasing, or a flip at the end or beyond.
    """
    before = 0.0
    for number, depth in enumerate(depths, start=1):
        if depth <= before:
            bound = f"> {before:g} m" + (", the flip before it" if number > 1 else "")
            raise UserError(f"flip {number} at {depth:g} m, expected {bound}")
        before = depth
    if depths and not before < end:
        raise OutOfBoundsError(f"flip {len(depths)}", before, 0.0, end, "m")


def bend_sign(depths: Sequence[float], insertion: float) -> float:
    """Return the desired sign of cos(roll), +1 or -1, at an insertion; 0 without flips.

    Parameters
    ----------
    depths : sequence of float
        Insertion depths of the flips [m].
    insertion : float
        Insertion depth [m]; at the depth of a flip, within 1 um, the sign is that after the flip.
    """
    if not depths:
        return 0.0
    done = sum(depth <= insertion + _DEPTH_TOLERANCE for depth in depths)
    return 1.0 if done % 2 == 0 else -1.0


class RollLaw:
    """Turns the base to the roll that leads the needle to the plane.

    Parameters
    ----------
    settings : RollLawSettings
        Gains and limits.
    """

    def __init__(self, settings: RollLawSettings) -> None:
        self.settings = settings

    def __call__(self, estimate: Estimate, bend_sign: float = 0.0) -> SteeringCommand:
        """Return the rotation rate to hold over the next step.

        Parameters
        ----------
        estimate : Estimate
            Estimate from the hypothesis filter; that of another estimator is treated as one
            hypothesis without torsion.
        bend_sign : float
            Desired sign of cos(roll), the side to which the needle bends within the plane; 0 for
            the nearer one. A change of sign is a turn by pi - 2 roll, which preserves the component
            of the curvature normal to the plane.
        """
        turn, desired = roll_turn(*hypotheses_of(estimate), float(bend_sign), self.settings)
        length = self.settings.step_length
        return SteeringCommand((desired - float(estimate.linearized[2])) / length, turn / length)


def hypotheses_of(estimate: Estimate) -> Hypotheses:
    """Return the hypotheses of an estimate, or the estimate as the only one.

    In the latter case, the angle of the base is unknown and assumed to be 0.
    """
    if estimate.hypotheses is not None:
        return estimate.hypotheses
    only, mean = np.zeros(1, TORSION), np.zeros(1, ESTIMATE)[0]
    only["roll"], only["curvature"] = estimate.coordinates[ROLL], estimate.curvature
    only["agreement"] = only["weight"] = only["gain"] = 1.0
    p, cosine = estimate.covariance, math.cos(float(estimate.coordinates[PITCH]))
    mean["coordinates"], mean["linearized"] = estimate.coordinates, estimate.linearized
    mean["curvature"] = estimate.curvature
    # d sin(pitch) = cos(pitch) dpitch
    mean["uncertainty"] = p[X, X], p[X, PITCH] * cosine, p[PITCH, PITCH] * cosine**2
    return Hypotheses(mean, only)


@compiled
def roll_turn(
    estimate: Any, torsions: Records, bend_sign: float, settings: RollLawSettings
) -> tuple[float, float]:
    """Return the rotation of the base over the next step [rad] and the desired s3 [1/m].

    Parameters
    ----------
    estimate, torsions : ESTIMATE, ndarray of TORSION
        See `Hypotheses`.
    bend_sign : float
        Desired sign of cos(roll); 0 for either.
    settings : RollLawSettings
        Settings of the law.
    """
    limit = settings.max_rotation_per_length * settings.step_length
    least = settings.smallest_weight * torsions["weight"].max()
    x, sin_pitch = estimate.linearized[0], estimate.linearized[1]
    turns = weights = s3_mean = 0.0
    for k in range(torsions.size):
        t = torsions[k]
        if t.weight < least or t.weight == 0.0:
            continue
        s3, sine = desired_bend(x, sin_pitch, estimate.uncertainty, t, settings)
        tip_turn = nearest_turn(t.roll, sine, bend_sign, estimate.wound, settings.max_winding)
        dead_band = settings.far_dead_band if abs(x) > settings.near else settings.near_dead_band
        dead_band += settings.scatter_dead_band * (1.0 - t.agreement)
        if abs(tip_turn) < dead_band:
            tip_turn = 0.0
        rotation = base_turn(t, tip_turn, estimate.base, settings.step_length)
        turns += t.weight * min(max(rotation, -settings.largest_turn), settings.largest_turn)
        s3_mean += t.weight * s3
        weights += t.weight
    return min(max(turns / weights, -limit), limit), s3_mean / weights


@compiled
def desired_bend(
    x: float, sin_pitch: float, uncertainty: Array, t: Any, settings: RollLawSettings
) -> tuple[float, float]:
    """Return the desired s3 [1/m] and the sine of the roll that has it.

    Parameters
    ----------
    x, sin_pitch : float
        Distance from the plane [m] and sine of the pitch, over all hypotheses.
    uncertainty : ndarray, shape (3,)
        Uncertainty of both; see `Hypotheses`.
    t : TORSION
        A torsion.
    settings : RollLawSettings
        Settings of the law.
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
    desired_pitch = -descent if x > 0.0 else descent
    steerable = t.curvature * math.sqrt(max(1e-6, 1.0 - sin_pitch * sin_pitch))
    gain = settings.pitch_gain * caution
    # Standard deviation of the desired s3, relative to the largest possible one.
    variance = uncertainty[2] + slope * (2.0 * uncertainty[1] + slope * uncertainty[0])
    uncertain = gain / steerable * math.sqrt(max(variance, 0.0))
    gain /= math.sqrt(1.0 + (settings.uncertainty_weight * uncertain) ** 2)
    # s3 = gain (desired sin(pitch) - sin(pitch)), limited by the curvature
    s3 = gain * (desired_pitch - sin_pitch)
    s3 = min(max(s3, -steerable), steerable)
    return s3, min(max(s3 / steerable, -1.0), 1.0)


@compiled
def nearest_turn(
    roll: float, sine: float, bend_sign: float, wound: float, max_winding: float
) -> float:
    """Return the shortest turn [rad] to a roll of a given sine within the limits of the base.

    Parameters
    ----------
    roll : float
        Present roll of the tip [rad].
    sine : float
        Sine of the desired roll.
    bend_sign : float
        Desired sign of its cosine; 0 for either.
    wound : float
        Angle of the base [rad].
    max_winding : float
        Limit of that angle's absolute value [rad]; if every turn exceeds it, the base unwinds.
    """
    upright = math.asin(sine)
    best = cheapest = math.inf
    for side in (1.0, -1.0):
        if side * bend_sign < 0.0:
            continue
        desired = upright if side > 0.0 else math.pi - upright
        turn, cost = allowed_turn(desired - roll, wound, max_winding)
        if cost < cheapest:
            best, cheapest = turn, cost
    return best


@compiled
def allowed_turn(turn: float, wound: float, max_winding: float) -> tuple[float, float]:
    """Return the shorter turn to an angle within the limits of the base, and its cost [rad].

    Parameters
    ----------
    turn : float
        Any turn to the angle [rad].
    wound, max_winding : float
        See `nearest_turn`.
    """
    shorter = (turn + math.pi) % (2.0 * math.pi) - math.pi
    best = cheapest = math.inf
    for candidate in (shorter, shorter - math.copysign(2.0 * math.pi, shorter)):
        cost = abs(candidate)
        over = abs(wound + candidate) - max_winding
        if over > 0.0:
            cost += 10.0 + over
        if cost < cheapest:
            best, cheapest = candidate, cost
    return best, cheapest


@compiled
def base_turn(t: Any, tip_turn: float, base: float, length: float) -> float:
    """Return the rotation of the base over a step that turns the tip by `tip_turn` [rad].

    Parameters
    ----------
    t : TORSION
        A torsion.
    tip_turn : float
        Desired turn of the tip [rad].
    base : float
        Rotation of the base since the start [rad].
    length : float
        Inserted length of the step [m].
    """
    if t.lag > _SMALLEST_LAG:
        # In one step, the tip covers a share of the difference to the angle behind the play.
        goal = t.tip_angle + tip_turn / (1.0 - math.exp(-length / t.lag))
    elif tip_turn == 0.0:
        goal = t.behind_play
    else:
        goal = t.tip_angle + tip_turn
    change = goal - t.behind_play
    if abs(change) < 1e-9:
        return 0.0
    return float((goal + math.copysign(t.play, change)) / t.gain - base)
