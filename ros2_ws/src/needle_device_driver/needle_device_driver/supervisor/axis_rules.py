"""Rules that the axes' replies may break."""

from __future__ import annotations

from needle_device_driver.axes.axis_pair import PairSnapshot
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_device_driver.supervisor.motion_run import Problem


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
