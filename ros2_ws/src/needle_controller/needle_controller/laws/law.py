"""Control laws: from an estimate to the rotation of the next step ([KC09] (7), (10))."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import virtual_input
from needle_controller.model.kinematics import ROLL
from needle_controller.observers.estimator import Estimate
from needle_controller.observers.luenberger import saturation_factor
from needle_core.compiled import compiled


@dataclasses.dataclass(frozen=True)
class SteeringCommand:
    """Command of a law for the next step.

    Attributes
    ----------
    virtual_input : float
        v [1/m^2] of (10), before the rotation is limited.
    rotation_rate : float
        u, rotation of the base per inserted length, after all limits [rad/m].
    insertion_left : float, optional
        Remaining insertion to the target, < 0 beyond it [m]; None if the depth determines the end.
    """

    virtual_input: float
    rotation_rate: float
    insertion_left: float | None = None


StepLaw = Callable[[Estimate, float], SteeringCommand]
"""Function of an estimate and its insertion [m]."""


class LinearizingGains(NamedTuple):
    """Settings of the law of [KC09].

    Attributes
    ----------
    feedback : ndarray, shape (3,)
        K of (10).
    step_length : float
        Inserted length over which u is held [m].
    demand_margin : float
        Distance of the demanded state from the border of the region of (6), in [0, 1).
    max_rotation_per_length : float
        Largest |u| [rad/m].
    """

    feedback: Array
    step_length: float
    demand_margin: float
    max_rotation_per_length: float


@compiled
def linearizing_rate(
    s: Array, roll: float, curvature: float, law: LinearizingGains
) -> tuple[float, float]:
    """Return v [1/m^2] and u [rad/m]: v = -K s (10); u from (7), integrated over the step; limited.

    u is held over a step, during which cos(roll) changes. Near roll +-90 deg, the inverse of (7) at
    the start of the step would divide by almost 0 and move the roll beyond that border, where s is
    ambiguous. Instead, v is held over the step in (8), the resulting s is saturated as the paper
    saturates the estimate, and u turns the roll to that of s. For short steps this is (7).

    Parameters
    ----------
    s, roll : ndarray, shape (3,), float
        The linearized state, and the roll [rad].
    curvature : float
        kappa [1/m].
    law : LinearizingGains
        Settings.
    """
    length, limit = law.step_length, law.max_rotation_per_length
    v = -(s[0] * law.feedback[0] + s[1] * law.feedback[1] + s[2] * law.feedback[2])
    s2 = s[1] + length * (s[2] + 0.5 * length * v)
    sine = (s[2] + length * v) / curvature
    scale = saturation_factor(s2, sine, law.demand_margin)
    s2, sine = scale * s2, scale * sine
    desired_roll = math.atan2(sine, math.sqrt(1.0 - s2 * s2 - sine * sine))
    # The drift of the roll, (5): -kappa cos(roll) tan(pitch), by (6) without trigonometric
    # functions.
    squared = s[1] * s[1]
    cosines = math.sqrt(max(1.0 - squared - (s[2] / curvature) ** 2, 0.0))
    cosines = math.copysign(cosines, 0.5 * math.pi - abs(roll))
    drift = -curvature * cosines * s[1] / (1.0 - squared)
    rate = (desired_roll - roll) / length - drift
    return v, min(max(rate, -limit), limit)


class LinearizingLaw:
    """The law of [KC09]; see `linearizing_rate`."""

    def __init__(self, gains: LinearizingGains) -> None:
        self.gains = gains

    def __call__(self, estimate: Estimate, _insertion: float = 0.0) -> SteeringCommand:
        """Return the rotation rate to hold over the next step."""
        roll, curvature = float(estimate.coordinates[ROLL]), float(estimate.curvature)
        return SteeringCommand(
            *linearizing_rate(np.array(estimate.linearized), roll, curvature, self.gains)
        )


class OpenLoopLaw:
    """u = 0: the needle bends freely; v is the resulting change of s3."""

    def __call__(self, estimate: Estimate, _insertion: float = 0.0) -> SteeringCommand:
        """Return no rotation."""
        return SteeringCommand(float(virtual_input(estimate.reduced, 0.0, estimate.curvature)), 0.0)
