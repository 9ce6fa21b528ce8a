"""docs/safety.md and the code have the same rules, and each rule has a test."""

from __future__ import annotations

import re
from pathlib import Path

from needle_device_driver.conformance.scenarios import RULES, verdict
from needle_device_driver.device_driver import DeviceDriver
from needle_device_driver.parameters import BACKENDS, DeviceDriverParameters
from needle_device_driver.rules import Rule

HERE = Path(__file__).resolve().parent
TABLE = (HERE.parents[3] / "docs" / "safety.md").read_text("utf-8")


def test_safety_table_lists_each_rule_and_each_rule_has_a_test() -> None:
    rules = sorted(rule.value for rule in Rule)
    assert sorted(re.findall(r"^\| `(\w+)` \|", TABLE, re.MULTILINE)) == rules
    tests = "".join(f.read_text("utf-8") for f in HERE.glob("supervised/rules/test_*_rules.py"))
    assert [rule for rule in rules if f"def test_{rule}" not in tests] == []
    assert "not a certified medical device" in TABLE


def test_safety_table_lists_the_rules_that_each_drive_keeps() -> None:
    header = re.search(r"^\| rule \| (cia402 .*) \|$", TABLE, re.MULTILINE)
    assert header
    names = header[1].split(" | ")
    for name in set(names) & set(BACKENDS):
        settings = DeviceDriverParameters(insertion_drive=name, rotation_drive=name, channel="can")
        drive = DeviceDriver(settings).drives[0].capabilities
        column = names.index(name) + 1
        for rule in RULES:
            row = re.search(rf"^\| {rule.value} \| .*$", TABLE, re.MULTILINE)
            assert row, rule
            assert row[0].strip("| ").split(" | ")[column] == verdict(rule, drive, settings)
