"""A limit that is given is the limit that is kept."""

from __future__ import annotations

import dataclasses

import pytest

from needle_device_driver.parameters import DeviceDriverParameters
from needle_device_driver.supervisor.limits import SafetyLimits

LIMITS = [field.name for field in dataclasses.fields(SafetyLimits)]


@pytest.mark.parametrize("name", LIMITS)
def test_each_limit_of_the_driver_is_a_parameter(name: str) -> None:
    default = getattr(DeviceDriverParameters(), name)
    given = DeviceDriverParameters(**{name: 0.9 * default}).limits
    assert getattr(given, name) == 0.9 * default
    assert {n: getattr(given, n) for n in LIMITS if n != name} == {
        n: getattr(DeviceDriverParameters().limits, n) for n in LIMITS if n != name
    }


def test_defaults_are_those_of_the_limits_but_for_what_real_drives_reach() -> None:
    limits, ideal = DeviceDriverParameters().limits, SafetyLimits()
    differ = {name for name in LIMITS if getattr(limits, name) != getattr(ideal, name)}
    assert differ == {"insertion_tolerance", "rotation_tolerance"}
