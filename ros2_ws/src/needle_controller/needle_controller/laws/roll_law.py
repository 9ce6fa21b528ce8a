"""The law of preset `best`: what roll takes the needle to the plane, and the turn that gives it.

In the linearized state s of [KC09] (6), x and sin(pitch) are the mean over all hypotheses. Far from
the plane the wanted pitch is the steepest from which the needle can still level out with a share of
its curvature, near it a straight line through 0; the wanted s3 takes the pitch there, and the roll
is turned the nearest way to one of the two that have this s3. Every hypothesis then says which turn
of the base takes the tip there through its own play and lag; the turns are averaged by weight.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from needle_controller.bank.hypotheses import bounded, check_bounded_fields
from needle_controller.bank.hypothesis_mixture import (
    COLUMNS,
    T_AGREEMENT,
    T_CURVATURE,
    T_ROLL,
    T_WEIGHT,
    Hypotheses,
    MixtureEstimate,
)
from needle_controller.laws.law import Command
from needle_controller.laws.roll_turns import RollLawNumbers, roll_turns
from needle_controller.model.kinematics import PITCH, ROLL, X
from needle_controller.observers.estimator import Estimate


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

    step_length: float = bounded(0.001, 1e-5, 0.1, "m")
    max_rotation_per_length: float = bounded(math.radians(30.0) / 0.001, 0.0, 1e5, "rad/m")
    max_winding: float = bounded(6.0 * math.pi, 2.0 * math.pi, 1e6, "rad")
    plane_gain: float = bounded(120.0, 0.0, 1e5, "1/m")
    pitch_gain: float = bounded(200.0, 0.0, 1e5, "1/m")
    braking_share: float = bounded(0.5, 0.01, 2.0, "-")
    braking_share_added: float = bounded(0.5, 0.0, 2.0, "-")
    braking_from: float = bounded(0.0025, 0.0, 1.0, "m")
    braking_over: float = bounded(0.003, 1e-6, 1.0, "m")
    lag_caution: float = bounded(0.45, 0.0, 1.0, "-")
    braking_caution: float = bounded(0.5, 0.0, 1.0, "-")
    doubt: float = bounded(1.0, 0.0, 10.0, "-")
    scatter_dead_band: float = bounded(1.0, 0.0, math.pi, "rad")
    near: float = bounded(0.0005, 0.0, 1.0, "m")
    near_dead_band: float = bounded(0.25, 0.0, math.pi, "rad")
    far_dead_band: float = bounded(0.15, 0.0, math.pi, "rad")
    largest_turn: float = bounded(2.0, 0.01, 100.0, "rad")
    smallest_weight: float = bounded(0.02, 0.0, 1.0, "-")

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
            np.ascontiguousarray(estimate.linearized[..., :2].reshape(-1, 2)),
            rows,
            np.ascontiguousarray(hypotheses.base.reshape(-1)),
            np.ascontiguousarray(hypotheses.wound.reshape(-1)),
            np.array(sign.reshape(-1)),
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
    table[..., 0, T_AGREEMENT] = 1.0
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
