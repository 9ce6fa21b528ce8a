"""Every safety rule that depends on the drives, with each kind of drive."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest

from needle_device_driver.axes.backend import HAND
from needle_device_driver.conformance.faults import FAULTS, can_satisfy
from needle_device_driver.conformance.plugin import ROW
from needle_device_driver.conformance.rig import ConformanceRig
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
    """Parametrize the tests with the chosen drives and number of random moments."""
    chosen = metafunc.config.getoption("axis")
    known = [name for name in BACKENDS if name != HAND]
    axes = chosen.split(",") if chosen else known
    if unknown := set(axes) - set(known):
        raise pytest.UsageError(f"--axis {', '.join(unknown)}: known are {', '.join(known)}")
    metafunc.parametrize("axis", axes)
    if "moment" in metafunc.fixturenames:
        metafunc.parametrize("moment", range(metafunc.config.getoption("moments")))


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.value)
def test_rule(axis: str, rule: Rule, record_property: Callable[[str, object], None]) -> None:
    """Check that the drives satisfy a rule as far as their abilities allow."""
    make = partial(ConformanceRig, 1, axis=axis)
    rig = make()
    text = verdict(rule, rig.capabilities, rig.settings)
    record_property(ROW, (axis, rule.value, text))
    if text != IMPOSSIBLE:
        check_rule(rule, make)


def test_fault_at_a_random_moment(axis: str, moment: int) -> None:
    """Cause each fault in turn at a random moment of set-up, homing, steps or rest."""
    make = partial(ConformanceRig, moment, axis=axis)
    fault = FAULTS[moment % len(FAULTS)]
    if can_satisfy(fault.rule, make().capabilities):
        random_moment(fault, make, moment)
