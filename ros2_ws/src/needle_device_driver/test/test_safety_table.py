"""docs/safety.md and the code name the same rules, and each rule has a test."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from needle_device_driver.rules import Rule

HERE = Path(__file__).resolve().parent
TABLE = HERE.parents[3] / "docs" / "safety.md"


def rows() -> list[str]:
    return re.findall(r"^\| `(\w+)` \|", TABLE.read_text(encoding="utf-8"), re.MULTILINE)


def test_the_table_has_each_rule_once() -> None:
    assert sorted(rows()) == sorted(rule.value for rule in Rule)


@pytest.mark.parametrize("rule", [rule.value for rule in Rule])
def test_each_rule_has_a_test_that_begins_with_its_name(rule: str) -> None:
    tests = list(HERE.glob("supervised/rules/test_*_rules.py"))
    assert any(f"def test_{rule}" in file.read_text(encoding="utf-8") for file in tests)


def test_the_table_says_that_this_is_no_medical_device() -> None:
    assert "not a certified medical device" in TABLE.read_text(encoding="utf-8")
