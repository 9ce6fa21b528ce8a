"""A sample of what `scripts/verify D` runs at full size; distances in time are not judged here."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from needle_verification.checking import Workbench
from needle_verification.checks import check_driver


def outcome(**changes: Any) -> dict[str, Any]:
    """A trial that went well."""
    return {
        "words": "cut_bus",
        "speed_mm_s": 5.0,
        "turn_rate_rad_s": 1.0,
        "distance_mm": 0.2,
        "state": "FAULT",
        "reason": "no reply",
        "logged": True,
        "drives_faulted": 2,
        "moved_by_itself_mm": 0.0,
        "trouble_after": "",
        **changes,
    }


def test_random_steps_add_up(tmp_path: Path) -> None:
    findings = list(check_driver.many_steps(Workbench(["simulate"], tmp_path), 12))
    # Twelve steps are too few to see memory grow.
    assert [f for f in findings if not f.passed and f.key != "steps_memory"] == []


def test_faults_are_named_and_need_a_command_to_go_on() -> None:
    # Distances are not judged here: a busy machine gets more time.
    kinds = ("cut_bus", "emcy", "kill_driver")
    outcomes = check_driver._trials("faults", 1, *kinds, "--watchdog", 0.5)
    assert tuple(found["kind"] for found in outcomes) == kinds
    for found in outcomes:
        findings = list(check_driver.judge_recovery(found["kind"], [found]))
        assert [finding for finding in findings if not finding.passed] == []


@pytest.mark.parametrize(
    ("change", "missed"),
    [
        ({}, set()),
        ({"distance_mm": 0.21}, {"cut_bus_bound"}),
        ({"state": "HOLDING"}, {"cut_bus_named"}),
        ({"logged": False}, {"cut_bus_named"}),
        ({"moved_by_itself_mm": 1e-4}, {"cut_bus_recovery"}),
        ({"trouble_after": "aborted: x"}, {"cut_bus_recovery"}),
    ],
)
def test_what_falls_short_is_a_miss(change: dict[str, Any], missed: set[str]) -> None:
    findings = check_driver.judge("cut_bus", [outcome(), outcome(**change)])
    assert {finding.key for finding in findings if not finding.passed} == missed
