"""Axes and their motion under way: set-points, what is wrong with either, when it has ended."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from needle_device_driver.axes.axis_pair import PairSnapshot
from needle_device_driver.axes.motion import CoordinatedMotion, Leg, SetPoint, slowed_legs
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_device_driver.supervisor.states import Activity

Problem = tuple[Rule, str]

INNER_SWITCH = "the insertion axis is at its inner limit switch"


def axes_problem(
    at: PairSnapshot, now: float, limits: SafetyLimits, *, powered_wanted: bool, homed_wanted: bool
) -> Problem | None:
    """Return the rule that the axes' newest replies break, and how."""
    if at.fault:
        return at.fault_rule, at.fault
    if at.age(now) > limits.reply_age_limit:
        return (
            Rule.REPLY_AGE,
            f"no reply from an axis for {at.age(now):.3f} s, limit {limits.reply_age_limit:g} s",
        )
    if powered_wanted and not at.powered:
        return Rule.ONE_FAULT_STOPS_BOTH, "an axis lost its power"
    if homed_wanted and not at.homed:
        return Rule.ONE_FAULT_STOPS_BOTH, "an axis lost its home position"
    return None


class MotionRun:
    """Leads both axes along one way.

    Parameters
    ----------
    activity : Activity
        STEP or RETRACTION; a retraction leaves the rotation axis alone.
    legs : sequence of Leg
        The way.
    at : PairSnapshot
        Where the axes are.
    limits : SafetyLimits
        The bounds.
    feedback_delay : int
        How many cycles after its order a set-point shows in a snapshot.
    pushed : bool
        Whether a hand moves the insertion axis: then rotation follows the measured insertion.
    """

    def __init__(
        self,
        activity: Activity,
        legs: Sequence[Leg],
        at: PairSnapshot,
        limits: SafetyLimits,
        *,
        feedback_delay: int,
        pushed: bool,
    ) -> None:
        self.activity = activity
        self._legs = tuple(legs)
        self._limits = limits
        self._pushed = pushed
        self._motion = self._begin(at)
        self._due: deque[SetPoint] = deque(maxlen=feedback_delay + 1)
        self._settling = 0.0

    def advance(self, at: PairSnapshot, period: float, speed_scale: float) -> SetPoint | None:
        """Return the set-point of the next `period` [s]; None while the axes come to rest."""
        if not at.ready:
            return None
        if not self._due:
            # The axes may have come to rest elsewhere since the order.
            self._motion = self._begin(at)
        if self._pushed:
            set_point = self._motion.follow(
                at.insertion.position, self._limits.max_rotation_rate, period
            )
        else:
            set_point = self._motion.advance(period, speed_scale)
        if self._motion.complete:
            self._settling += period
        self._due.append(set_point)
        return set_point

    def replace(self, legs: Sequence[Leg], at: PairSnapshot) -> None:
        """Go another way from the last set-point on, without a stop."""
        self._legs = tuple(legs)
        self._motion = self._begin(at)
        self._settling = 0.0

    def rotation_owed(self, at: PairSnapshot) -> float:
        """Return by how much the rotation is behind a needle that a hand pushes [rad]."""
        if not (self._pushed and self._due):
            return 0.0
        return abs(self._motion.rotation_at(at.insertion.position) - self._due[-1].rotation)

    def problem(self, at: PairSnapshot) -> Problem | None:
        """Return the rule that the motion breaks, and how."""
        limits = self._limits
        if self.activity is Activity.STEP and at.insertion.at_inner_switch:
            return Rule.INNER_LIMIT_SWITCH, INNER_SWITCH
        if self._settling > limits.settling_time:
            return (
                Rule.SETTLING_TIME,
                f"the axes are not at their target {limits.settling_time:g} s after the last "
                f"set-point: {self._off(at)}",
            )
        if len(self._due) < (self._due.maxlen or 1):
            return None
        due = self._due[0]
        insertion = abs(due.insertion - at.insertion.position)
        if not self._pushed and insertion > limits.insertion_following_error:
            return (
                Rule.FOLLOWING_ERROR,
                f"the insertion axis is {insertion * 1e3:.3f} mm off its set-point, "
                f"limit {limits.insertion_following_error * 1e3:g} mm",
            )
        rotation = abs(due.rotation - at.rotation.position)
        if self.activity is Activity.STEP and rotation > limits.rotation_following_error:
            return (
                Rule.FOLLOWING_ERROR,
                f"the rotation axis is {rotation:.3f} rad off its set-point, "
                f"limit {limits.rotation_following_error:g} rad",
            )
        return None

    def arrived(self, at: PairSnapshot) -> bool:
        """Return whether the motion has ended; a retraction also ends at the home switch."""
        if self.activity is Activity.RETRACTION and at.insertion.at_home_switch:
            return True
        end = self._legs[-1]
        return (
            self._motion.complete
            and (
                self._pushed
                or abs(end.insertion - at.insertion.position) <= self._limits.insertion_tolerance
            )
            and (
                self.activity is Activity.RETRACTION
                or abs(end.rotation - at.rotation.position) <= self._limits.rotation_tolerance
            )
        )

    def _begin(self, at: PairSnapshot) -> CoordinatedMotion:
        # From the last set-point: a motor rests beside it, and counted from there the first
        # set-point could be too far ahead.
        start = at.insertion.set_point, at.rotation.set_point
        if self.activity is Activity.RETRACTION:
            legs = slowed_legs(start, self._legs, max_speed=self._limits.retraction_speed)
        else:
            legs = slowed_legs(
                start,
                self._legs,
                max_speed=self._limits.max_speed,
                max_rotation_rate=self._limits.max_rotation_rate,
            )
        return CoordinatedMotion(start, legs)

    def _off(self, at: PairSnapshot) -> str:
        end = self._legs[-1]
        insertion = abs(end.insertion - at.insertion.position)
        rotation = abs(end.rotation - at.rotation.position)
        return f"insertion {insertion * 1e3:.4f} mm, rotation {rotation:.5f} rad off"
