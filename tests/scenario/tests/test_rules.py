"""Every safety rule: a scene that it protects, and a bug that disables it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest

from needle_core.errors import UserError
from needle_device_driver.conformance.rig import ConformanceRig
from needle_device_driver.conformance.scenarios import RULES as DRIVE_RULES
from needle_device_driver.conformance.scenarios import check_rule
from needle_device_driver.rules import Rule
from scenario.rules.bugs import BUGS
from scenario.rules.scenes import SCENES as OTHER_RULES

CIA402 = partial(ConformanceRig, 1, axis="cia402")
SCENES: dict[str, Callable[[], None]] = {
    **{rule.value: partial(check_rule, rule, CIA402) for rule in DRIVE_RULES},
    **OTHER_RULES,
}
RULES = sorted(rule.value for rule in Rule)


def test_each_rule_has_a_scene_and_a_bug() -> None:
    # Its row in docs/safety.md and its own test: needle_device_driver/test/test_safety_table.py.
    assert sorted(SCENES) == sorted(BUGS) == RULES


@pytest.mark.parametrize("rule", RULES)
def test_a_scene_passes_only_with_its_rule(rule: str, monkeypatch: pytest.MonkeyPatch) -> None:
    SCENES[rule]()
    BUGS[rule](monkeypatch)
    with pytest.raises((AssertionError, UserError)):
        SCENES[rule]()
