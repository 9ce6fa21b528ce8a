"""The point law within a preset: with a rig's settings, on a target that may move."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Protocol

import numpy as np
import numpy.typing as npt

from needle_controller.laws.law import SteeringCommand
from needle_controller.laws.point_law import PointLaw
from needle_controller.laws.point_turns import PointLawSettings
from needle_controller.model.arrays import Array
from needle_controller.model.target_motion import WINDOW, TargetMotion
from needle_controller.observers.estimator import Estimate
from needle_controller.presets.own_law import OwnLaw, tried_law
from needle_controller.presets.steering_settings import SteeringSettings

_LOOKS = 4
"""How often the time of arrival is corrected at a step; it goes on from that of the step before."""
_CORRECTED = 0.5
"""Share of such a correction: the target may come towards the needle faster than that goes in."""
_AVERAGED = 0.010
"""The needle will be as fast as over so much insertion [m]."""
_CLOCKS_APART = 1.0
"""A target seen so long after the tip is stamped by another clock [s]."""


class LawToPoint(Protocol):
    """A law for points: `PointLaw`, or that of another package."""

    def __call__(
        self, estimate: Estimate, target: npt.ArrayLike, rotation_left: float = np.inf
    ) -> SteeringCommand:
        """Return the command for the next step; see `PointLaw`."""


class Foresight:
    """Foresees where a target will be when the needle is there.

    Of one needle; or, in a study, of several that are inserted alike: times, lengths and points
    then have one row for each.

    Parameters
    ----------
    motion : TargetMotion
        Where the target was seen; times are seconds of the tips' clock.

    Attributes
    ----------
    motion : TargetMotion
        See above.
    """

    def __init__(self, motion: TargetMotion) -> None:
        self.motion = motion
        self._insertions: deque[tuple[float, float]] = deque()
        self._arrival: Array | float | None = None
        self._foretold: Array | None = None

    @property
    def aim(self) -> Array:
        """Target as expected when the needle is there [m]."""
        return self.motion.last if self._foretold is None else self._foretold

    def look(
        self,
        time: Array | float,
        insertion: Array | float,
        left: Callable[[Array], Array | float],
    ) -> Array:
        """Return the target as expected when the needle is there [m].

        Parameters
        ----------
        time, insertion : float
            Of the last tip [s], [m].
        left : callable
            Returns the insertion that is left to a point [m].
        """
        now = float(np.max(time))
        speed = self._speed(now, float(np.max(insertion)))
        self._foretold = None
        if speed is None or not -_CLOCKS_APART <= now - self.motion.seen <= WINDOW:
            return self.aim
        if self._arrival is None:
            self._arrival = time + np.maximum(left(self.aim), 0.0) / speed
        for _ in range(_LOOKS):
            self._foretold = self.motion.at(self._arrival)
            arrival = time + np.maximum(left(self.aim), 0.0) / speed
            self._arrival = self._arrival + _CORRECTED * (arrival - self._arrival)
        return self.aim

    def _speed(self, time: float, insertion: float) -> float | None:
        """Return how fast the needle goes in [m/s]; None while it has not moved."""
        seen = self._insertions
        if seen and (time <= seen[-1][0] or insertion < seen[-1][1]):
            seen.clear()
        seen.append((time, insertion))
        while len(seen) > 2 and insertion - seen[1][1] >= _AVERAGED:
            seen.popleft()
        began, inserted = seen[0]
        return (insertion - inserted) / (time - began) if insertion > inserted else None


class PointSteering:
    """Steers to where a target will be when the needle is there.

    Parameters
    ----------
    settings : SteeringSettings
        What the law is made of; `SteeringSettings.check_steers_to_points` says who can.
    motion : TargetMotion
        Where the target was seen, in `rig`; times are seconds of the tips' clock.

    Attributes
    ----------
    motion : TargetMotion
        See above.
    """

    def __init__(self, settings: SteeringSettings, motion: TargetMotion) -> None:
        self._law = point_law(settings)
        self._foresight = Foresight(motion)
        self.motion = motion

    @property
    def aim(self) -> Array:
        """Target as expected when the needle is there, in `rig`, shape (3,) [m]."""
        return self._foresight.aim

    def command(
        self,
        estimate: Estimate,
        time: float,
        insertion: float,
        rotation_left: float,
        from_rig: Callable[[Array], Array] = np.asarray,
    ) -> SteeringCommand:
        """Return the rotation rate to hold over the next step, and the insertion left.

        Parameters
        ----------
        estimate : Estimate
            Of the needle at `time`.
        time, insertion : float
            Of the tip that it is made from [s], [m].
        rotation_left : float
            What the base may still turn, either way [rad].
        from_rig : callable
            Takes points of `rig` to the estimate's frame.
        """

        def left(target: Array) -> float:
            command = self._law(estimate, from_rig(target))
            assert command.insertion_left is not None
            return command.insertion_left

        aim = self._foresight.look(time, insertion, left)
        return self._law(estimate, from_rig(aim), rotation_left)


def point_law(settings: SteeringSettings) -> LawToPoint:
    """Return the law for points; `SteeringSettings.check_steers_to_points` says who can."""
    if settings.law:
        return OwnLaw(tried_law(settings.law), settings).to_point
    return PointLaw(PointLawSettings(**settings.turning))


def prompt_point_law(settings: SteeringSettings) -> LawToPoint:
    """Return the law for points that turns the bevel at once: as paths are planned."""
    if settings.law:
        return point_law(settings)
    return PointLaw(
        PointLawSettings(
            **settings.turning,
            reserve=1.0,
            last_turn=0.0,
            last_turns_from=settings.step_length,
            dead_band=0.05,
        )
    )
