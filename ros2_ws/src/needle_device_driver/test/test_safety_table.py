"""docs/safety.md and the code have the same rules, and each rule has a test."""

from __future__ import annotations

import re
from pathlib import Path

from needle_device_driver.rules import Rule

HERE = Path(__file__).resolve().parent
TABLE = (HERE.parents[3] / "docs" / "safety.md").read_text("utf-8")


def test_safety_table_lists_each_rule_and_each_rule_has_a_test() -> None:
    rules = sorted(rule.value for rule in Rule)
    assert sorted(re.findall(r"^\| `(\w+)` \|", TABLE, re.MULTILINE)) == rules
    tests = "".join(f.read_text("utf-8") for f in HERE.glob("supervised/rules/test_*_rules.py"))
    assert [rule for rule in rules if f"def test_{rule}" not in tests] == []
    assert "not a certified medical device" in TABLE
