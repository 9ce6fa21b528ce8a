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

_MEANING = "the rotation of the base per inserted length [rad/m], for each needle"


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
        self, estimate: Estimate, target: npt.ArrayLike, rotation_left: npt.ArrayLike = np.inf
    ) -> SteeringCommand:
        """Return the rotation rate to hold over the next step, to a point; see `PointLaw`."""
        goal = np.broadcast_to(np.asarray(target, dtype=float), estimate.position.shape)
        with self._part.blamed("to_point"):
            rate = self._own.to_point(estimate, goal.copy())
        return self._command("to_point()", rate, estimate, _arc_left(estimate, goal))

    def _command(
        self, what: str, rate: Any, estimate: Estimate, left: Array | None = None
    ) -> SteeringCommand:
        checked = self._part.checked(what, rate, estimate.curvature.shape, _MEANING)
        held = np.clip(checked, -self._limit, self._limit)
        wanted = virtual_input(estimate.reduced, checked, estimate.curvature)
        return SteeringCommand(np.asarray(wanted), np.asarray(held), left)


@cache
def tried_law(name: str) -> OwnPart:
    """Return an own law's class that has steered a needle, and two at once.

    Raises
    ------
    OwnPartError
        As of `own_part`; also where it raises, or what it says is no rotation rate.
    """
    part = own_part("law", name)
    law = OwnLaw(part, SteeringSettings())
    for needles in ((), (2,)):
        turn = np.broadcast_to(np.eye(3), (*needles, 3, 3))
        estimate = pose_estimate(
            np.zeros((*needles, 3)), turn, np.full(needles, 8.0), np.eye(6) * 1e-6
        )
        law(estimate, 0.001)
        if callable(getattr(part.made_by, "to_point", None)):
            law.to_point(estimate, np.array([0.0, 0.0, 0.1]))
    return part


def _arc_left(estimate: Estimate, target: Array) -> Array:
    """Return the length of the arc that leaves along the heading and leads to a target, (...) [m].

    Negative of a target that lies behind.
    """
    way = ((target - estimate.position)[..., None, :] @ estimate.rotation)[..., 0, :]
    aside, ahead = np.hypot(way[..., 0], way[..., 1]), way[..., 2]
    angle = np.arctan2(aside, np.abs(ahead))
    return np.asarray(np.copysign(np.hypot(aside, ahead) / np.sinc(angle / np.pi), ahead))
