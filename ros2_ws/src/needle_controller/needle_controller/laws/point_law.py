"""Law for points: turns the bevel so that the needle's arc leads to the target.

The law needs no plane and no plan. The arc from the mean pose to the target needs a share of the
needle's curvature, which grows while the needle bends elsewhere. The law waits until a turn towards
the target, made one step later, would leave no reserve. Then it turns the bevel; the needle bends
towards the target and past that direction, and the law waits again. The reserve, which grows with
the uncertainty, shrinks to zero over the last centimetres, where errors can no longer be
corrected. Each hypothesis then determines the turn of the base for that turn of the tip.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from needle_controller.laws.law import SteeringCommand
from needle_controller.laws.point_turns import (
    PointLawSettings,
    desired_turn,
    insertion_to_closest_point,
    mean_slack,
    write_lateral_offset,
)
from needle_controller.laws.roll_law import allowed_turn, base_turn, hypotheses_of
from needle_controller.model.arrays import Array, Records
from needle_controller.model.feedback_linearization import virtual_input
from needle_controller.model.kinematics import ROLL
from needle_controller.observers.estimator import Estimate
from needle_core.compiled import compiled


class PointLaw:
    """Turns the base so that the tip reaches a point.

    Parameters
    ----------
    settings : PointLawSettings
        Limits, reserve and dead bands.
    """

    def __init__(self, settings: PointLawSettings) -> None:
        self.settings = settings

    def __call__(
        self,
        estimate: Estimate,
        target: npt.ArrayLike,
        rotation_left: float = math.inf,
    ) -> SteeringCommand:
        """Return the rotation rate for the next step, and the remaining insertion.

        Parameters
        ----------
        estimate : Estimate
            Estimate of the hypothesis filter, or of another estimator of the full pose, which
            counts as one hypothesis without torsion.
        target : array_like, shape (3,)
            Target of the tip in the frame of the estimate [m]. It may move between calls.
        rotation_left : float
            Remaining rotation of the base, in either direction [rad]; the less remains, the less
            often it turns.
        """
        goal = np.array(target, dtype=float)
        turn, left = point_turn(*hypotheses_of(estimate), goal, float(rotation_left), self.settings)
        rate = turn / self.settings.step_length
        virtual = virtual_input(estimate.reduced, rate, estimate.curvature)
        return SteeringCommand(float(virtual), rate, left)


@compiled
def point_turn(
    estimate: Any,
    torsions: Records,
    target: Array,
    rotation_left: float,
    settings: PointLawSettings,
) -> tuple[float, float]:
    """Return the turn of the base in the next step [rad] and the remaining insertion [m].

    Parameters
    ----------
    estimate, torsions : ESTIMATE, ndarray of TORSION
        See `Hypotheses`.
    target : ndarray, shape (3,)
        Target of the tip [m].
    rotation_left : float
        Remaining rotation of the base, in either direction; infinite without a limit [rad].
    settings : PointLawSettings
        The settings.
    """
    coordinates, uncertainty = estimate.coordinates, estimate.uncertainty
    curvature, wound = estimate.curvature, estimate.wound
    ahead, need = _in_frame_of_tip(coordinates, target), np.empty(2)
    arc_length = write_lateral_offset(ahead, need)
    left = insertion_to_closest_point(ahead, arc_length, curvature)
    if arc_length <= 0.0:
        return 0.0, left
    # Standard deviation of x + arc_length sin(pitch)
    variance = uncertainty[0] + arc_length * (2.0 * uncertainty[1] + arc_length * uncertainty[2])
    std = math.sqrt(max(variance, 0.0))
    slack = mean_slack(torsions, settings.max_rotation_per_length)
    needed_turn = desired_turn(need, arc_length, curvature, std, slack, rotation_left, settings)
    least = settings.smallest_weight * torsions["weight"].max()
    turns = weights = 0.0
    for k in range(torsions.size):
        t = torsions[k]
        if t.weight < least or t.weight == 0.0:
            continue
        tip_turn = 0.0
        if needed_turn != 0.0:
            to_torsion = needed_turn + coordinates[ROLL] - t.roll
            tip_turn = allowed_turn(to_torsion, wound, settings.max_winding)[0]
        if abs(tip_turn) < settings.scatter_dead_band * (1.0 - t.agreement):
            tip_turn = 0.0
        base_turned = base_turn(t, tip_turn, estimate.base, settings.step_length)
        turns += t.weight * min(max(base_turned, -settings.largest_turn), settings.largest_turn)
        weights += t.weight
    most = min(settings.max_rotation_per_length * settings.step_length, rotation_left)
    return min(max(turns / weights, -most), most), left


@compiled
def _in_frame_of_tip(coordinates: Array, target: Array) -> Array:
    """Return a target in the tip's frame: R^T (target - p), R = Rx(yaw) Ry(pitch) Rz(roll)."""
    x, y, z = target[0] - coordinates[0], target[1] - coordinates[1], target[2] - coordinates[2]
    c, s = math.cos(coordinates[3]), math.sin(coordinates[3])
    y, z = c * y + s * z, c * z - s * y
    c, s = math.cos(coordinates[4]), math.sin(coordinates[4])
    x, z = c * x - s * z, c * z + s * x
    c, s = math.cos(coordinates[5]), math.sin(coordinates[5])
    return np.array([c * x + s * y, c * y - s * x, z])
