"""Every safety rule that depends on the drives, with each kind of drive."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest

from needle_device_driver.axes.backend import HAND
from needle_device_driver.conformance.faults import FAULTS, largest_travel
from needle_device_driver.conformance.plugin import ROW
from needle_device_driver.conformance.rig import ConformanceRig
from needle_device_driver.conformance.scenarios import SCENARIOS, any_fault, random_moment
from needle_device_driver.parameters import BACKENDS
from needle_device_driver.rules import Rule

RULES = tuple(dict.fromkeys((*SCENARIOS, *(fault.rule for fault in FAULTS))))
IMPOSSIBLE = "not possible"


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run each test with all chosen drives, and random moments as often as chosen."""
    chosen = metafunc.config.getoption("axis")
    known = [name for name in BACKENDS if name != HAND]
    metafunc.parametrize("axis", chosen.split(",") if chosen else known)
    if "moment" in metafunc.fixturenames:
        metafunc.parametrize("moment", range(metafunc.config.getoption("moments")))


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.value)
def test_rule(axis: str, rule: Rule, record_property: Callable[[str, object], None]) -> None:
    """Run the rule's scenarios; the motors stay within the stated bounds."""
    make = partial(ConformanceRig, 1, axis=axis)
    rig = make()
    faults = [fault for fault in FAULTS if fault.rule is rule]
    needs = faults[0].needs if faults else SCENARIOS[rule][1]
    verdict = "enforced"
    if not needs(rig.capabilities):
        verdict = IMPOSSIBLE
    elif faults:
        bound = max(largest_travel(fault, rig) for fault in faults)
        verdict = f"within {bound[0] * 1e3:.2f} mm"
    record_property(ROW, (axis, rule.value, verdict))
    if verdict != IMPOSSIBLE:
        for fault in faults:
            any_fault(fault, make)
        if not faults:
            SCENARIOS[rule][0](make)


def test_fault_at_a_random_moment(axis: str, moment: int) -> None:
    """Cause each fault in turn at a random moment of set-up, homing, steps or rest."""
    make = partial(ConformanceRig, moment, axis=axis)
    fault = FAULTS[moment % len(FAULTS)]
    if fault.needs(make().capabilities):
        random_moment(fault, make, moment)
