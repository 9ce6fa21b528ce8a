"""What is wrong with the axes, if anything, and whether a motion has arrived."""

from __future__ import annotations

from needle_device_driver.axis_pair import PairSnapshot
from needle_device_driver.limits import SafetyLimits
from needle_device_driver.motion import CoordinatedMotion, SetPoint
from needle_device_driver.rules import Rule
from needle_device_driver.states import Activity

Problem = tuple[Rule, str]


def axes_problem(
    at: PairSnapshot, now: float, limits: SafetyLimits, *, powered_wanted: bool, homed_wanted: bool
) -> Problem | None:
    """Return the rule that the axes' newest replies break, and how."""
    if at.fault:
        return Rule.ONE_FAULT_STOPS_BOTH, at.fault
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


def following_problem(
    set_point: SetPoint, at: PairSnapshot, activity: Activity, limits: SafetyLimits
) -> Problem | None:
    """Return how far an axis is from where it was sent, if that is too far."""
    insertion = abs(set_point.insertion - at.insertion.position)
    if insertion > limits.insertion_following_error:
        return (
            Rule.FOLLOWING_ERROR,
            f"the insertion axis is {insertion * 1e3:.3f} mm off its set-point, "
            f"limit {limits.insertion_following_error * 1e3:g} mm",
        )
    rotation = abs(set_point.rotation - at.rotation.position)
    if activity is Activity.STEP and rotation > limits.rotation_following_error:
        return (
            Rule.FOLLOWING_ERROR,
            f"the rotation axis is {rotation:.3f} rad off its set-point, "
            f"limit {limits.rotation_following_error:g} rad",
        )
    return None


def arrived(
    motion: CoordinatedMotion, at: PairSnapshot, activity: Activity, limits: SafetyLimits
) -> bool:
    """Return whether a step or retraction has ended; a retraction also ends at the home switch."""
    if activity is Activity.RETRACTION and at.insertion.at_home_switch:
        return True
    insertion, rotation = motion.end
    return (
        motion.complete
        and abs(insertion - at.insertion.position) <= limits.insertion_tolerance
        and (
            activity is Activity.RETRACTION
            or abs(rotation - at.rotation.position) <= limits.rotation_tolerance
        )
    )
