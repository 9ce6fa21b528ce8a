"""A control law of another package: tried when it is loaded, and held to the rig's limits."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from needle_controller.laws.law import SteeringCommand
from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import virtual_input
from needle_controller.observers.estimator import Estimate, pose_estimate
from needle_controller.presets.own_parts import OwnPart, own_part
from needle_controller.presets.steering_settings import SteeringSettings

_MEANING = "the rotation of the base per inserted length [rad/m]"


class OwnLaw:
    """An own law as the rest knows one: a `StepLaw`, and a law for points where it is one.

    It says how far the base is to turn for each length inserted; what that does to s3 follows by
    (7), how far a point is from the arc that leads there. Turns are held within
    `max_rotation_per_length`.

    Parameters
    ----------
    part : OwnPart
        Which.
    settings : SteeringSettings
        Of the controller.
    """

    def __init__(self, part: OwnPart, settings: SteeringSettings) -> None:
        self._part = part
        self._limit = settings.max_rotation_per_length
        with part.blamed(f"{part.made_by.__name__}(settings)"):
            self._own = part.made_by(settings)

    def __call__(self, estimate: Estimate, insertion: float) -> SteeringCommand:
        """Return the rotation rate to hold over the next step, to the plane."""
        with self._part.blamed("to_plane"):
            rate = self._own.to_plane(estimate, insertion)
        return self._command("to_plane()", rate, estimate)

    def to_point(
        self, estimate: Estimate, target: npt.ArrayLike, rotation_left: float = np.inf
    ) -> SteeringCommand:
        """Return the rotation rate to hold over the next step, to a point; see `PointLaw`."""
        goal = np.array(target, dtype=float)
        with self._part.blamed("to_point"):
            rate = self._own.to_point(estimate, goal.copy())
        return self._command("to_point()", rate, estimate, _arc_left(estimate, goal))

    def _command(
        self, what: str, rate: Any, estimate: Estimate, left: float | None = None
    ) -> SteeringCommand:
        checked = float(self._part.checked(what, rate, (), _MEANING))
        held = min(max(checked, -self._limit), self._limit)
        wanted = virtual_input(estimate.reduced, checked, estimate.curvature)
        return SteeringCommand(float(wanted), held, left)


@cache
def tried_law(name: str) -> OwnPart:
    """Return an own law's class that has steered a needle.

    Raises
    ------
    OwnPartError
        As of `own_part`; also where it raises, or what it says is no rotation rate.
    """
    part = own_part("law", name)
    law = OwnLaw(part, SteeringSettings())
    estimate = pose_estimate(np.zeros(3), np.eye(3), 8.0, np.eye(6) * 1e-6)
    law(estimate, 0.001)
    if callable(getattr(part.made_by, "to_point", None)):
        law.to_point(estimate, np.array([0.0, 0.0, 0.1]))
    return part


def _arc_left(estimate: Estimate, target: Array) -> float:
    """Return the length of the arc that leaves along the heading and leads to a target [m].

    Negative of a target that lies behind.
    """
    x, y, ahead = (target - estimate.position) @ estimate.rotation
    aside = np.hypot(x, y)
    angle = np.arctan2(aside, np.abs(ahead))
    return float(np.copysign(np.hypot(aside, ahead) / np.sinc(angle / np.pi), ahead))
