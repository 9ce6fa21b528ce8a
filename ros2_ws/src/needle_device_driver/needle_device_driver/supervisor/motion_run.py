"""Motion under way and its bounds: set-points, homing time, retraction distance."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from needle_device_driver.axes.axis import AxisSnapshot, PairSnapshot
from needle_device_driver.axes.motion import CoordinatedMotion, Leg, SetPoint, slowed_legs
from needle_device_driver.rules import Problem, Rule
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_device_driver.supervisor.states import Activity

INNER_SWITCH = "the insertion axis is at its inner limit switch"
# Weight of the time at the switch: a drive leaves it at a quarter of the homing speed.
_OFF_SWITCH = 0.25


def axes_problem(
    at: PairSnapshot, now: float, limits: SafetyLimits, *, require_power: bool, require_home: bool
) -> Problem | None:
    """Return the rule that the axes break, and how."""
    if at.fault:
        return Problem(at.fault_rule, at.fault)
    if at.age(now) > limits.reply_age_limit:
        return Problem(
            Rule.REPLY_AGE,
            f"no reply from an axis for {at.age(now):.3f} s, limit {limits.reply_age_limit:g} s",
        )
    if require_power and not at.powered:
        return Problem(Rule.ONE_FAULT_STOPS_BOTH, "an axis lost its power")
    if require_home and not at.homed:
        return Problem(Rule.ONE_FAULT_STOPS_BOTH, "an axis lost its home position")
    return None


class MotionRun:
    """Moves both axes along one path.

    Parameters
    ----------
    activity : Activity
        STEP or RETRACTION; a retraction does not move the rotation axis.
    legs : sequence of Leg
        The path.
    at : PairSnapshot
        Feedback of the axes.
    limits : SafetyLimits
        The bounds.
    feedback_delay : int
        Number of cycles until a set-point shows in the feedback.
    pushed : bool
        Whether the needle is inserted by hand; rotation then follows the measured insertion.
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
            # The axes may have moved while they came to rest.
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
        """Continue along another path from the last set-point, without a stop."""
        self._legs = tuple(legs)
        self._motion = self._begin(at)
        self._settling = 0.0

    def rotation_lag(self, at: PairSnapshot) -> float:
        """Return the lag of the rotation behind a needle that is pushed by hand [rad]."""
        if not (self._pushed and self._due):
            return 0.0
        return abs(self._motion.rotation_at(at.insertion.position) - self._due[-1].rotation)

    def problem(self, at: PairSnapshot) -> Problem | None:
        """Return the rule that the motion breaks, and how."""
        limits = self._limits
        if self.activity is Activity.STEP and at.insertion.at_inner_switch:
            return Problem(Rule.INNER_LIMIT_SWITCH, INNER_SWITCH)
        if self._settling > limits.settling_time:
            insertion, rotation = self._distance_to_end(at)
            return Problem(
                Rule.SETTLING_TIME,
                f"the axes are not at their target {limits.settling_time:g} s after the last "
                f"set-point: insertion {insertion * 1e3:.4f} mm, rotation {rotation:.5f} rad off",
            )
        if len(self._due) < (self._due.maxlen or 1):
            return None
        due = self._due[0]
        insertion = abs(due.insertion - at.insertion.position)
        if not self._pushed and insertion > limits.insertion_following_error:
            return Problem(
                Rule.FOLLOWING_ERROR,
                f"the insertion axis is {insertion * 1e3:.3f} mm off its set-point, "
                f"limit {limits.insertion_following_error * 1e3:g} mm",
            )
        rotation = abs(due.rotation - at.rotation.position)
        if self.activity is Activity.STEP and rotation > limits.rotation_following_error:
            return Problem(
                Rule.FOLLOWING_ERROR,
                f"the rotation axis is {rotation:.3f} rad off its set-point, "
                f"limit {limits.rotation_following_error:g} rad",
            )
        return None

    def arrived(self, at: PairSnapshot) -> bool:
        """Return whether the motion has ended; a retraction also ends at the home switch."""
        retracts = self.activity is Activity.RETRACTION
        if retracts and at.insertion.at_home_switch:
            return True
        insertion, rotation = self._distance_to_end(at)
        return (
            self._motion.complete
            and (self._pushed or insertion <= self._limits.insertion_tolerance)
            and (retracts or rotation <= self._limits.rotation_tolerance)
        )

    def _begin(self, at: PairSnapshot) -> CoordinatedMotion:
        # Start at the last set-point: a motor may rest off it, and a path from the measured
        # position could begin with a jump of the set-point.
        start = at.insertion.set_point, at.rotation.set_point
        retracts, limits = self.activity is Activity.RETRACTION, self._limits
        speed = limits.retraction_speed if retracts else limits.max_speed
        return CoordinatedMotion(
            start, slowed_legs(start, self._legs, speed, limits.max_rotation_rate)
        )

    def _distance_to_end(self, at: PairSnapshot) -> tuple[float, float]:
        end = self._legs[-1]
        return (
            abs(end.insertion - at.insertion.position),
            abs(end.rotation - at.rotation.position),
        )


class HomingTimes:
    """Rule `homing_time`: bounds the search of each axis for its home switch.

    Parameters
    ----------
    limits : SafetyLimits
        Limits with the longest homings.
    """

    def __init__(self, limits: SafetyLimits) -> None:
        self._longest = limits.longest_homings
        self._times = [0.0, 0.0]

    def advance(self, at: PairSnapshot, period: float) -> str:
        """Add `period` [s]; return which axis has taken too long, or an empty text."""
        for k, (name, axis) in enumerate(at.by_name.items()):
            self._times[k] += period * axis.moving * (_OFF_SWITCH if axis.at_home_switch else 1)
            if self._times[k] > self._longest[k]:
                return f"the {name} axis did not find its home switch in {self._longest[k]:.0f} s"
        return ""


class RetractionBound:
    """Bounds a retraction: remembers the last known depth when the home position is lost.

    Parameters
    ----------
    max_depth : float
        Bound if the depth has never been known [m].
    """

    def __init__(self, max_depth: float) -> None:
        self._remaining = max_depth
        self._before: AxisSnapshot | None = None

    def note(self, insertion: AxisSnapshot) -> None:
        """Record a snapshot of the insertion axis; call it with every snapshot."""
        before, self._before = self._before, insertion
        if insertion.homed or before is None:
            return
        if before.homed:
            self._remaining = before.position
        elif before.origin == insertion.origin:
            self._remaining += insertion.position - before.position

    def target(self, insertion: AxisSnapshot) -> float:
        """Return the position at which a retraction must end [m]."""
        return 0.0 if insertion.homed else insertion.position - self._remaining
