"""Every safety rule that depends on the drives, with each kind of drive."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from needle_device_driver.axes.backend import HAND
from needle_device_driver.conformance.faults import FAULTS
from needle_device_driver.conformance.plugin import ROW
from needle_device_driver.conformance.rig import rigs_with
from needle_device_driver.conformance.scenarios import (
    IMPOSSIBLE,
    RULES,
    check_rule,
    random_moment,
    verdict,
)
from needle_device_driver.parameters import BACKENDS
from needle_device_driver.rules import Rule


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run each test with all chosen drives, and random moments as often as chosen."""
    chosen = metafunc.config.getoption("axis")
    known = [name for name in BACKENDS if name != HAND]
    metafunc.parametrize("axis", chosen.split(",") if chosen else known)
    if "moment" in metafunc.fixturenames:
        metafunc.parametrize("moment", range(metafunc.config.getoption("moments")))


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.value)
def test_rule(axis: str, rule: Rule, record_property: Callable[[str, object], None]) -> None:
    """Check that the drives keep a rule as their abilities say."""
    make = rigs_with(axis)
    rig = make()
    text = verdict(rule, rig.capabilities, rig.settings)
    record_property(ROW, (axis, rule.value, text))
    if text != IMPOSSIBLE:
        check_rule(rule, make)


def test_fault_at_a_random_moment(axis: str, moment: int) -> None:
    """Cause each fault in turn at a random moment of set-up, homing, steps or rest."""
    make = rigs_with(axis, moment)
    fault = FAULTS[moment % len(FAULTS)]
    if fault.needs(make().capabilities):
        random_moment(fault, make, moment)
