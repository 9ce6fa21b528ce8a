"""Steering to a point that may move: the point law with the settings of a rig."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from needle_controller.laws.law import SteeringCommand
from needle_controller.laws.point_law import PointLaw
from needle_controller.laws.point_turns import PointLawSettings
from needle_controller.model.arrays import Array
from needle_controller.model.target_motion import WINDOW, TargetMotion
from needle_controller.observers.estimator import Estimate
from needle_controller.presets.own_controllers import OwnLaw, checked_law
from needle_controller.presets.steering_settings import SteeringSettings

_ITERATIONS = 4
"""Corrections of the arrival time per step; the iteration continues from the previous step."""
_RELAXATION = 0.5
"""Share of each correction: a target may approach faster than the needle advances."""
_SPEED_WINDOW = 0.010
"""Insertion over which the speed of the needle is averaged [m]."""
_CLOCK_DIFFERENCE = 1.0
"""Target stamps later than the tip's by more than this come from another clock [s]."""


LawToPoint = Callable[..., SteeringCommand]
"""Law for points, called as `PointLaw`; it may be a plug-in."""


class ArrivalPrediction:
    """Prediction of the target's position at the arrival of the needle.

    A study predicts several needles that advance equally: times, lengths and points then have one
    row per needle.

    Parameters
    ----------
    motion : TargetMotion
        Observed motion of the target; times are seconds of the tips' clock.
    """

    def __init__(self, motion: TargetMotion) -> None:
        self.motion = motion
        self._insertions: deque[tuple[float, float]] = deque()
        self._arrival: Array | float | None = None
        self._predicted: Array | None = None

    @property
    def aim(self) -> Array:
        """Predicted position of the target at the arrival [m]."""
        return self.motion.last if self._predicted is None else self._predicted

    def predict(
        self,
        time: Array | float,
        insertion: Array | float,
        left: Callable[[Array], Array | float],
    ) -> Array:
        """Return the predicted position of the target at the arrival [m].

        Parameters
        ----------
        time, insertion : float
            Time [s] and insertion [m] of the last tip.
        left : callable
            Returns the remaining insertion to a point [m].
        """
        now = float(np.max(time))
        speed = self._speed(now, float(np.max(insertion)))
        self._predicted = None
        if speed is None or not -_CLOCK_DIFFERENCE <= now - self.motion.last_time <= WINDOW:
            return self.aim
        if self._arrival is None:
            self._arrival = time + np.maximum(left(self.aim), 0.0) / speed
        for _ in range(_ITERATIONS):
            self._predicted = self.motion.at(self._arrival)
            arrival = time + np.maximum(left(self.aim), 0.0) / speed
            self._arrival = self._arrival + _RELAXATION * (arrival - self._arrival)
        return self.aim

    def _speed(self, time: float, insertion: float) -> float | None:
        """Return the insertion speed [m/s], or None before the needle has moved."""
        samples = self._insertions
        if samples and (time <= samples[-1][0] or insertion < samples[-1][1]):
            samples.clear()
        samples.append((time, insertion))
        while len(samples) > 2 and insertion - samples[1][1] >= _SPEED_WINDOW:
            samples.popleft()
        first_time, first = samples[0]
        return (insertion - first) / (time - first_time) if insertion > first else None


class PointSteering(ArrivalPrediction):
    """Steers to the predicted position of a target at the arrival of the needle.

    Parameters
    ----------
    settings : SteeringSettings
        Settings of the law, which must pass `SteeringSettings.check_steers_to_points`.
    motion : TargetMotion
        Observed motion of the target, in `rig`; times are seconds of the tips' clock.
    """

    def __init__(self, settings: SteeringSettings, motion: TargetMotion) -> None:
        super().__init__(motion)
        self._law = point_law(settings)

    def command(
        self,
        estimate: Estimate,
        time: float,
        insertion: float,
        rotation_left: float,
        from_rig: Callable[[Array], Array] = np.asarray,
    ) -> SteeringCommand:
        """Return the rotation rate for the next step, and the remaining insertion.

        Parameters
        ----------
        estimate : Estimate
            Estimate of the needle at `time`.
        time, insertion : float
            Time [s] and insertion [m] of its tip.
        rotation_left : float
            Remaining rotation of the base, in either direction [rad].
        from_rig : callable
            Transforms points from `rig` to the frame of the estimate.
        """

        def left(target: Array) -> float:
            command = self._law(estimate, from_rig(target))
            assert command.insertion_left is not None
            return command.insertion_left

        aim = self.predict(time, insertion, left)
        return self._law(estimate, from_rig(aim), rotation_left)


def point_law(settings: SteeringSettings, *, is_prompt: bool = False) -> LawToPoint:
    """Return the law for points of checked settings.

    A prompt law turns the bevel immediately, as planned paths require; a law of another package
    decides for itself.
    """
    if settings.law:
        return OwnLaw(checked_law(settings.law), settings).to_point
    turns = PointLawSettings(**settings.turning)
    if is_prompt:
        length = settings.step_length
        turns = turns._replace(reserve=1.0, last_turn=0.0, last_turns_from=length, dead_band=0.05)
    return PointLaw(turns)
