"""From an estimate to the rotation of the next step ([KC09] (7), (10))."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Protocol

import numpy as np

from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import virtual_input
from needle_controller.model.kinematics import ROLL
from needle_controller.observers.estimator import Estimate
from needle_controller.observers.luenberger_steps import demand_states


@dataclasses.dataclass(frozen=True)
class SteeringCommand:
    """The law's command for the next step.

    Attributes
    ----------
    virtual_input : ndarray, shape (...)
        v [1/m^2], as wanted by (10), before what limits the rotation.
    rotation_rate : ndarray, shape (...)
        u, rotation of the base per inserted length, after all limits [rad/m].
    insertion_left : ndarray, shape (...), optional
        Insertion after which the needle is there, < 0 beyond it [m]; None from a law that does not
        say: then the depth does.
    """

    virtual_input: Array
    rotation_rate: Array
    insertion_left: Array | None = None


StepLaw = Callable[[Estimate, float], SteeringCommand]
"""Takes the estimate and the insertion it is of [m]."""


class Law(Protocol):
    """A control law: called once per step."""

    def __call__(self, estimate: Estimate) -> SteeringCommand:
        """Return the rotation rate to hold over the next step."""


@dataclasses.dataclass(frozen=True)
class LinearizingLaw:
    """v = -K s (10); u from (7), integrated over the step; |u| capped.

    u is held over a step, during which cos(roll) changes: the inverse of (7) at the step's start
    would, near roll +-90 deg, divide by almost 0 and carry the roll past that border, where s
    cannot say so. So the wanted v is held over the step in (8) instead, the s it leads to is
    saturated as the paper saturates the estimate, and u is what takes the roll there. For short
    steps this is (7).

    Attributes
    ----------
    feedback : ndarray, shape (3,)
        K of (10).
    step_length : float
        Inserted length over which u is held [m].
    demand_margin : float
        Distance of the demanded state from the border of (6)'s region, in [0, 1).
    max_rotation_per_length : float
        Largest |u| [rad/m].
    """

    feedback: Array
    step_length: float
    demand_margin: float
    max_rotation_per_length: float

    def __call__(self, estimate: Estimate) -> SteeringCommand:
        """Return the rotation rate to hold over the next step."""
        s, length, curvature = estimate.linearized, self.step_length, estimate.curvature
        v = np.asarray(-(s @ self.feedback))
        sine, cosine = np.empty(v.size), np.empty(v.size)
        curvatures = np.broadcast_to(curvature, v.shape).flatten()
        held = length, self.demand_margin
        demand_states(s.reshape(-1, 3), v.reshape(-1), curvatures, held, (sine, cosine))
        wanted_roll = np.arctan2(sine, cosine).reshape(v.shape)
        roll = estimate.coordinates[..., ROLL]
        # The roll's own drift, (5): cos(roll) tan(pitch), by (6) without their slow functions.
        squared = s[..., 1] ** 2
        steered = np.maximum(1.0 - squared - (s[..., 2] / curvature) ** 2, 0.0)
        cosines = np.copysign(np.sqrt(steered), 0.5 * np.pi - np.abs(roll))
        drift = -curvature * cosines * s[..., 1] / (1.0 - squared)
        limit = self.max_rotation_per_length
        rate = np.clip((wanted_roll - roll) / length - drift, -limit, limit)
        return SteeringCommand(v, np.asarray(rate))


class OpenLoopLaw:
    """u = 0: the needle bends as it will; v says what that does to s3."""

    def __call__(self, estimate: Estimate) -> SteeringCommand:
        """Return no rotation."""
        rate = np.zeros(estimate.coordinates.shape[:-1])
        return SteeringCommand(virtual_input(estimate.reduced, rate, estimate.curvature), rate)
