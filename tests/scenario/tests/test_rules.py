"""Every safety rule: a row in the documentation, a test, a scene in which it counts, and a bug."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from code_lines import ROOT
from needle_core.errors import UserError
from needle_device_driver.rules import Rule
from scenario.rules import command_scenes, drive_scenes
from scenario.rules.bugs import BUGS

SCENES: dict[str, Callable[[], None]] = {
    scene.__name__: scene for scene in (*command_scenes.SCENES, *drive_scenes.SCENES)
}
TESTS = ROOT / "ros2_ws/src/needle_device_driver/test/supervised/rules"
RULES = sorted(rule.value for rule in Rule)


def test_each_rule_has_a_row_a_test_a_scene_and_a_bug() -> None:
    rows = (ROOT / "docs/safety.md").read_text("utf-8")
    tests = "".join(path.read_text("utf-8") for path in TESTS.glob("test_*.py"))
    assert [rule for rule in RULES if rows.count(f"\n| `{rule}` |") != 1] == []
    assert [rule for rule in RULES if f"def test_{rule}" not in tests] == []
    assert sorted(SCENES) == sorted(BUGS) == RULES


@pytest.mark.parametrize("rule", RULES)
def test_a_rule_counts(rule: str) -> None:
    SCENES[rule]()


@pytest.mark.parametrize("rule", RULES)
def test_without_its_rule_a_scene_goes_wrong(rule: str, monkeypatch: pytest.MonkeyPatch) -> None:
    BUGS[rule](monkeypatch)
    with pytest.raises((AssertionError, UserError)):
        SCENES[rule]()
