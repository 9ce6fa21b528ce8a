"""Limits of docs/safety.md, and their caps."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest

from needle_core.errors import OutOfBoundsError, UserError
from needle_device_driver.parameters import DeviceDriverParameters
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_device_driver.supervisor.reports import Notice, NoticeLimit

# Default, and hard bound.
LIMITS = {
    "max_depth": (0.2, 0.5),
    "max_step_length": (0.002, 0.005),
    "max_speed": (0.005, 0.005),
    "max_rotation_step": (1.2, 2.0 * math.pi),
    "max_rotation_rate": (math.pi, 20.0),
    "max_turns": (10.0, 1000.0),
    "hold_timeout": (0.25, 0.5),
    "tip_age_limit": (2.0, 60.0),
    "reply_age_limit": (0.1, 0.5),
    "retraction_speed": (0.002, 0.005),
    "homing_speed": (0.002, 0.005),
    "homing_rotation_rate": (1.0, 20.0),
    "insertion_following_error": (0.0005, 10.0),
    "rotation_following_error": (0.1, 10.0),
    "insertion_tolerance": (5e-6, 1.0),
    "rotation_tolerance": (1e-3, 1.0),
    "settling_time": (1.0, 10.0),
}


def test_limits_are_positive_and_have_these_defaults_and_caps() -> None:
    defaults = {name: default for name, (default, _) in LIMITS.items()}
    assert dataclasses.asdict(SafetyLimits.of(DeviceDriverParameters())) == defaults
    # Ideal axes have smaller tolerances.
    ideal = defaults | {"insertion_tolerance": 1e-6, "rotation_tolerance": 1e-4}
    assert dataclasses.asdict(SafetyLimits()) == ideal
    for name, (default, cap) in LIMITS.items():
        assert getattr(SafetyLimits(**{name: cap}), name) == cap
        with pytest.raises(OutOfBoundsError, match=name):
            SafetyLimits(**{name: cap * 1.001})
        for bad in (0.0, -1.0, math.nan):
            with pytest.raises(UserError, match=name):
                SafetyLimits(**{name: bad})
        changed: dict[str, Any] = {name: 0.9 * default}
        given = SafetyLimits.of(DeviceDriverParameters(**changed))
        assert dataclasses.asdict(given) == defaults | changed
    assert SafetyLimits().longest_homings == pytest.approx((150.0, 1.5 * 20.0 * math.pi))


def test_notices_of_one_rule_are_limited_and_counted() -> None:
    limit, refused = NoticeLimit(), Notice("refused", Rule.TIP_AGE)
    texts = [limit.admit(refused, 100.0 + number * 1e-3) for number in range(999)]
    assert [text for text in texts if text] == ["refused [tip_age]"] * 5
    assert limit.admit(Notice("late", Rule.HOLD_AGE), 100.9) == "late [hold_age]"
    assert limit.admit(Notice("stopped", Rule.TIP_AGE, fault=True), 100.9) == "stopped [tip_age]"
    assert limit.admit(refused, 101.0) == "refused [tip_age] (994 more not logged)"
    assert limit.admit(refused, 101.1) == "refused [tip_age]"
