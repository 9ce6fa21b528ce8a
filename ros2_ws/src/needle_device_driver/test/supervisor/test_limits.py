"""Bounds are those of docs/safety.md, and the hard ones cannot be configured away."""

from __future__ import annotations

import dataclasses
import math

import pytest

from needle_core.errors import OutOfBoundsError, UserError
from needle_device_driver.parameters import DeviceDriverParameters
from needle_device_driver.supervisor import command_stamps, hold, limits, stamp_ages
from needle_device_driver.supervisor.limits import SafetyLimits

BOUNDS = {
    "max_depth": 0.2,
    "max_step_length": 0.002,
    "max_speed": 0.005,
    "max_rotation_step": 1.2,
    "max_rotation_rate": math.pi,
    "max_turns": 10.0,
    "hold_timeout": 0.25,
    "tip_age_limit": 2.0,
    "reply_age_limit": 0.1,
    "retraction_speed": 0.002,
    "homing_speed": 0.002,
    "homing_rotation_rate": 1.0,
    "insertion_following_error": 0.0005,
    "rotation_following_error": 0.1,
    "insertion_tolerance": 5e-6,
    "rotation_tolerance": 1e-3,
    "settling_time": 1.0,
}
HARD = {
    "max_step_length": 0.005,
    "max_speed": 0.005,
    "retraction_speed": 0.005,
    "homing_speed": 0.005,
    "hold_timeout": 0.5,
}


def test_bounds_of_the_driver_are_those_of_the_document() -> None:
    assert dataclasses.asdict(DeviceDriverParameters().limits) == BOUNDS


@pytest.mark.parametrize("name", HARD)
def test_a_hard_bound_is_the_largest_that_can_be_configured(name: str) -> None:
    assert getattr(SafetyLimits(**{name: HARD[name]}), name) == HARD[name]
    with pytest.raises(OutOfBoundsError, match=name):
        SafetyLimits(**{name: HARD[name] * 1.001})


@pytest.mark.parametrize("name", BOUNDS)
@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_a_bound_that_bounds_nothing_is_refused(name: str, bad: float) -> None:
    with pytest.raises(UserError, match=name):
        SafetyLimits(**{name: bad})


def test_bounds_that_are_no_parameters_are_those_of_the_document() -> None:
    assert limits.HARD_STEP_TIME_CAP == 600.0
    assert hold.MAX_SOURCES == 16
    assert command_stamps._REMEMBERED_STEPS == 2000
    assert stamp_ages.AHEAD_NS == 100_000_000
    assert SafetyLimits().longest_homings == pytest.approx((1.5 * 100.0, 1.5 * 62.83), rel=1e-4)
