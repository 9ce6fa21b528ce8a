"""The law of preset `best`: what roll takes the needle to the plane, and the turn that gives it.

In the linearized state s of [KC09] (6), x and sin(pitch) are the mean over all hypotheses. Far from
the plane the wanted pitch is the steepest from which the needle can still level out with a share of
its curvature, near it a straight line through 0; the wanted s3 takes the pitch there, and the roll
is turned the nearest way to one of the two that have this s3. Every hypothesis then says which turn
of the base takes the tip there through its own play and lag; the turns are averaged by weight.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from needle_controller.bank.hypothesis_mixture import (
    COLUMNS,
    T_AGREEMENT,
    T_CURVATURE,
    T_ROLL,
    T_WEIGHT,
    Hypotheses,
    MixtureEstimate,
)
from needle_controller.laws.law import SteeringCommand
from needle_controller.laws.roll_turns import RollLawSettings, roll_turns
from needle_controller.model.kinematics import PITCH, ROLL, X
from needle_controller.observers.estimator import Estimate
from needle_core.settings.bounds import check_bounded_fields


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

    def __call__(self, estimate: Estimate, bend_sign: npt.ArrayLike = 0.0) -> SteeringCommand:
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
            self.settings,
            turn,
            wanted,
        )
        length = self.settings.step_length
        rate = turn.reshape(shape) / length
        virtual = (wanted.reshape(shape) - estimate.linearized[..., 2]) / length
        return SteeringCommand(np.asarray(virtual), np.asarray(rate))


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
