"""Control laws of other packages, tested when they are loaded and limited in rotation rate."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from needle_controller.laws.law import SteeringCommand
from needle_controller.laws.point_turns import write_lateral_offset
from needle_controller.model.feedback_linearization import virtual_input
from needle_controller.observers.estimator import Estimate, pose_estimate
from needle_controller.presets.own_parts import OwnPart, own_part
from needle_controller.presets.steering_settings import SteeringSettings

_MEANING = "the rotation of the base per inserted length [rad/m]"


class OwnLaw:
    """A law of another package as a `StepLaw` and, if it has `to_point`, a law for points.

    The law returns the rotation of the base per inserted length, limited to
    `max_rotation_per_length`. The virtual input follows from (7), the remaining insertion from the
    arc to the point.

    Parameters
    ----------
    part : OwnPart
        The law.
    settings : SteeringSettings
        Settings of the controller.
    """

    def __init__(self, part: OwnPart, settings: SteeringSettings) -> None:
        self._part = part
        self._limit = settings.max_rotation_per_length
        self._law = part.make(settings)

    def __call__(self, estimate: Estimate, insertion: float) -> SteeringCommand:
        """Return the command for the next step to the plane."""
        rate = self._part.call("to_plane", self._law.to_plane, estimate, insertion)
        return self._command("to_plane()", rate, estimate)

    def to_point(
        self, estimate: Estimate, target: npt.ArrayLike, rotation_left: float = np.inf
    ) -> SteeringCommand:
        """Return the command for the next step to a point; see `PointLaw`."""
        goal = np.array(target, dtype=float)
        rate = self._part.call("to_point", self._law.to_point, estimate, goal.copy())
        arc_length = write_lateral_offset(
            (goal - estimate.position) @ estimate.rotation, np.empty(2)
        )
        return self._command("to_point()", rate, estimate, arc_length)

    def _command(
        self, what: str, rate: Any, estimate: Estimate, left: float | None = None
    ) -> SteeringCommand:
        checked = float(self._part.checked(what, rate, (), _MEANING))
        limited = min(max(checked, -self._limit), self._limit)
        virtual = virtual_input(estimate.reduced, checked, estimate.curvature)
        return SteeringCommand(float(virtual), limited, left)


@cache
def checked_law(name: str) -> OwnPart:
    """Return the class of a law of another package, after a trial.

    Raises
    ------
    OwnPartError
        As for `own_part`; also if the law raises, or does not return a rotation rate.
    """
    part = own_part("law", name)
    law = OwnLaw(part, SteeringSettings())
    estimate = pose_estimate(np.zeros(3), np.eye(3), 8.0, np.eye(6) * 1e-6)
    law(estimate, 0.001)
    if callable(getattr(part.cls, "to_point", None)):
        law.to_point(estimate, np.array([0.0, 0.0, 0.1]))
    return part
