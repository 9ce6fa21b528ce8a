"""A rig on two computers, its cable cut: a small version of `scripts/verify K`."""

from __future__ import annotations

from pathlib import Path

import pytest

from needle_core.errors import UserError
from needle_verification.checking import Workbench, trial_outcomes
from needle_verification.checks import check_computers
from patience import GENEROUS_MS

MODULE = "needle_verification.ros.computers.cable_trials"


def test_a_cut_cable_ends_the_motion_and_nothing_goes_on_by_itself() -> None:
    try:
        (seen,) = trial_outcomes(MODULE, 1, "--longest", 1.0)
    except UserError as error:
        if "no second computer" not in str(error):
            raise
        pytest.skip(str(error))
    assert seen["moving"] and seen["lost"], seen
    assert 0.0 < seen["last_motion_ms"] < GENEROUS_MS, seen
    assert seen["resumed_mm"] == 0.0, seen


@pytest.mark.parametrize(
    ("change", "passed"),
    [
        ({}, [True, True, True]),
        ({"last_motion_ms": 155.1}, [False, True, True]),
        ({"resumed_mm": 1e-6}, [True, False, True]),
        ({"lost": False, "length_s": 0.1, "last_motion_ms": 900.0}, [True, True, True]),
        ({"lost": False, "length_s": 0.5}, [False, True, True]),
    ],
)
def test_what_falls_short_is_a_miss(
    change: dict[str, float],
    passed: list[bool],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    good = {
        **{"length_s": 1.0, "moving": True, "lost": True, "last_motion_ms": 120.0},
        **{"distance_mm": 0.5, "resumed_mm": 0.0, "again_s": 0.3},
    }
    monkeypatch.setattr(check_computers, "trial_outcomes", lambda *_: [good, {**good, **change}])
    findings = check_computers.two_computers(Workbench([], tmp_path), 2)
    assert [finding.passed for finding in findings] == passed


def test_a_trial_that_is_missing_is_a_miss(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(check_computers, "trial_outcomes", lambda *_: [])
    findings = list(check_computers.two_computers(Workbench([], tmp_path), 2))
    assert not findings[0].passed
    assert not findings[2].passed


@pytest.mark.parametrize(
    ("change", "passed"),
    [({}, True), ({"last_motion_ms": 155.1}, False), ({"resumed_mm": 1e-6}, False)],
)
def test_a_clock_that_changes_what_a_cut_does_is_a_miss(
    change: dict[str, float], passed: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    good = {"last_motion_ms": 120.0, "resumed_mm": 0.0}
    monkeypatch.setattr(check_computers, "trial_outcomes", lambda *_: [good, {**good, **change}])
    findings = list(check_computers.clocks_differ(Workbench([], tmp_path), 2))
    assert [finding.passed for finding in findings] == [passed, passed]
