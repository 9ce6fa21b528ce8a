"""A law for points: the bevel is turned so that the needle's arc leads to the target.

No plane and no plan. From the mean pose the arc that leads to the target takes a share of the
needle's curvature; what it takes grows while the needle bends elsewhere. So the bevel is left
alone until a turn to the target, made one step later, would leave no reserve; then it is turned
there, the needle bends to the target and past that direction, and the bevel is left alone again.
The reserve, and what is kept for doubt, shrink to nothing over the last centimetres, where nothing
can be made up for. Every hypothesis then says which turn of the base gives that turn of the tip.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from needle_controller.laws.law import SteeringCommand
from needle_controller.laws.point_turns import PointLawSettings, point_turns
from needle_controller.laws.roll_law import hypotheses_of
from needle_controller.model.feedback_linearization import virtual_input
from needle_controller.model.kinematics import ROLL
from needle_controller.observers.estimator import Estimate
from needle_core.errors import OutOfBoundsError
from needle_core.settings.bounds import check_bounded_fields


class PointLaw:
    """Turns the base so that the tip comes to a point.

    Parameters
    ----------
    settings : PointLawSettings
        Limits, reserve and dead bands.

    Raises
    ------
    OutOfBoundsError
        A setting that is outside its bounds, or the last turns end before they begin.
    """

    def __init__(self, settings: PointLawSettings) -> None:
        check_bounded_fields(settings)
        if settings.last_turns_from <= settings.last_turn:
            least = math.nextafter(settings.last_turn, math.inf)
            raise OutOfBoundsError("last_turns_from", settings.last_turns_from, least, 1.0, "m")
        self.settings = settings

    def __call__(
        self,
        estimate: Estimate,
        target: npt.ArrayLike,
        rotation_left: npt.ArrayLike = math.inf,
    ) -> SteeringCommand:
        """Return the rotation rate to hold over the next step, and the insertion left.

        Parameters
        ----------
        estimate : Estimate
            Of the hypothesis filter, or of another estimator of the full pose: then as one
            hypothesis without torsion.
        target : array_like, shape (..., 3)
            Where the tip is to go, in the estimate's frame [m]. It may move between calls.
        rotation_left : array_like, shape (...)
            What the base may still turn, either way [rad]: it turns as seldom as that takes.
        """
        hypotheses = hypotheses_of(estimate)
        shape = hypotheses.base.shape
        points = np.broadcast_to(np.asarray(target, dtype=float), (*shape, 3))
        needles = hypotheses.base.size
        turn, left = np.empty(needles), np.empty(needles)
        point_turns(
            np.ascontiguousarray(estimate.position.reshape(-1, 3)),
            np.ascontiguousarray(estimate.rotation.reshape(-1, 3, 3)),
            np.ascontiguousarray(estimate.coordinates[..., ROLL].reshape(-1)),
            np.array(np.broadcast_to(estimate.curvature, shape).reshape(-1)),
            hypotheses.table.reshape(-1, *hypotheses.table.shape[-2:]),
            np.ascontiguousarray(hypotheses.base.reshape(-1)),
            np.ascontiguousarray(hypotheses.wound.reshape(-1)),
            np.ascontiguousarray(hypotheses.uncertainty.reshape(-1, 3)),
            np.array(points.reshape(-1, 3)),
            np.array(np.broadcast_to(np.asarray(rotation_left, dtype=float), shape).reshape(-1)),
            self.settings,
            turn,
            left,
        )
        rate = turn.reshape(shape) / self.settings.step_length
        virtual = virtual_input(estimate.reduced, rate, estimate.curvature)
        return SteeringCommand(np.asarray(virtual), np.asarray(rate), left.reshape(shape))
