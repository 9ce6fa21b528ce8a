"""Estimators and laws of other packages, tested when they are loaded and checked at every step."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from needle_controller.laws.law import SteeringCommand
from needle_controller.laws.point_turns import write_lateral_offset
from needle_controller.model.arc_motion import arc
from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import virtual_input
from needle_controller.observers.estimator import Estimate, pose_estimate
from needle_controller.presets.own_parts import OwnPart, own_part
from needle_controller.presets.steering_settings import SteeringSettings

_TRIAL_STEPS, _STEP = 20, 0.001
_LARGEST_ERROR = 0.005
"""Largest distance from an exact tip at the end of the trial [m]."""
_FRAME_TOLERANCE = 1e-4
_CHECKS = (
    ("coordinates", (6,), "numbers x, y, z [m], yaw, pitch, roll [rad]"),
    ("linearized", (3,), "numbers s1, s2, s3 of (6)"),
    ("curvature", (), "curvature [1/m]"),
    ("covariance", (6, 6), "the covariance of the coordinates, in their order"),
)
"""Attributes of an estimate, their shapes, and their descriptions."""

_RATE = "the rotation of the base per inserted length [rad/m]"


class OwnEstimator:
    """Wraps an estimator of another package as an `estimator.Estimator`.

    Exceptions and invalid estimates become an `OwnPartError` that names the package.

    Parameters
    ----------
    part : OwnPart
        The estimator.
    settings : SteeringSettings
        Settings of the controller.
    initial_rotation : array_like, shape (3, 3)
        Orientation at the entry with the base's rotation at 0, in `target_plane`.
    entry : array_like, shape (3,), optional
        Entry point in `target_plane` [m]; None if it is not known.
    rng : numpy.random.Generator
        Source of all randomness in the estimator.
    """

    def __init__(
        self,
        part: OwnPart,
        settings: SteeringSettings,
        initial_rotation: npt.ArrayLike,
        entry: npt.ArrayLike | None,
        rng: np.random.Generator,
    ) -> None:
        self._part = part
        entry_point = None if entry is None else np.array(entry, dtype=float)
        self._own = part.make(settings, np.array(initial_rotation, dtype=float), entry_point, rng)

    def reset(self, tip: npt.ArrayLike, joints: npt.ArrayLike) -> None:
        """Start over at a first measurement; see `Estimator.reset`."""
        start = np.array(tip, dtype=float), np.array(joints, dtype=float)
        self._part.call("reset", self._own.reset, *start)

    def advance(self, d_insertion: float, d_rotation: float) -> None:
        """Advance by the actual motion; see `Estimator.advance`."""
        self._part.call("advance", self._own.advance, float(d_insertion), float(d_rotation))

    def correct(
        self, tip: npt.ArrayLike, covariance: npt.ArrayLike | None = None, age: float = 0.0
    ) -> None:
        """Correct by a measured tip; see `Estimator.correct`."""
        matrix = None if covariance is None else np.array(covariance, dtype=float)
        position = np.array(tip, dtype=float)
        self._part.call("correct", self._own.correct, position, matrix, float(age))

    def correct_heading(self, direction: npt.ArrayLike, variance: float) -> None:
        """Pass a heading measured with the tip of the next `correct`, if the estimator uses it."""
        if method := getattr(self._own, "correct_heading", None):
            heading = np.array(direction, dtype=float)
            self._part.call("correct_heading", method, heading, float(variance))

    def estimate(self) -> Estimate:
        """Return the present estimate; see `Estimator.estimate`."""
        part = self._part
        estimate = part.call("estimate", self._own.estimate)
        if not isinstance(estimate, Estimate):
            raise part.error(
                f"estimate() returned {type(estimate).__name__}, expected an Estimate "
                "(needle_controller.observers.estimator.pose_estimate makes one)"
            )
        for name, shape, meaning in _CHECKS:
            part.checked(f"estimate().{name}", getattr(estimate, name), shape, meaning)
        if not estimate.curvature > 0.0:
            raise part.error(f"estimate().curvature is {estimate.curvature:g} 1/m, expected > 0")
        return estimate

    def change_frame(self, T_new_old: npt.ArrayLike) -> None:  # noqa: N803
        """Transform everything into another target plane; see `Estimator.change_frame`."""
        transform = np.array(T_new_old, dtype=float)
        self._part.call("change_frame", self._own.change_frame, transform)


@cache
def checked_estimator(name: str) -> OwnPart:
    """Return the class of an estimator of another package, after a trial with one needle.

    Raises
    ------
    OwnPartError
        As for `own_part`; also if the estimator raises, returns an invalid estimate, loses a needle
        whose tips are exact, fails at a missing tip, or transforms incorrectly to another plane.
    """
    part = own_part("estimator", name)
    settings = SteeringSettings()
    rng = np.random.default_rng(0)
    estimator = OwnEstimator(part, settings, np.eye(3), np.zeros(3), rng)
    covariance = np.eye(3) * settings.measurement_std**2
    estimator.reset(np.zeros(3), np.zeros(2))
    tip: Array = np.zeros(3)
    for k in range(1, _TRIAL_STEPS + 1):
        pose = arc(k * _STEP, 0.0, settings.curvature)
        tip = pose.shift
        estimator.advance(_STEP, 0.0)
        estimator.correct_heading(pose.rotation[:, 2], 1e-4)
        estimator.correct(tip, None if k % 2 else covariance, 0.0)
        estimator.estimate()
    error = float(np.linalg.norm(estimator.estimate().position - tip))
    if error > _LARGEST_ERROR:
        raise part.error(
            f"after {_TRIAL_STEPS} exact tips, 1 mm apart, its position is {error:.3g} m "
            "off; expected m, in the target plane, z along the insertion"
        )
    estimator.advance(_STEP, 0.0)
    estimator.correct(np.full(3, np.nan), None, 0.0)
    before = estimator.estimate().position
    moved = np.eye(4)
    moved[0, 3] = 0.002
    estimator.change_frame(moved)
    after = estimator.estimate().position
    if not np.allclose(after, before + moved[:3, 3], rtol=0.0, atol=_FRAME_TOLERANCE):
        by = float(after[0] - before[0])
        raise part.error(f"change_frame by 0.002 m along x moves x by {by:g} m")
    return part


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
        self, what: str, rate: Any, estimate: Estimate, insertion_left: float | None = None
    ) -> SteeringCommand:
        checked = float(self._part.checked(what, rate, (), _RATE))
        limited = min(max(checked, -self._limit), self._limit)
        virtual = virtual_input(estimate.reduced, checked, estimate.curvature)
        return SteeringCommand(float(virtual), limited, insertion_left)


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
