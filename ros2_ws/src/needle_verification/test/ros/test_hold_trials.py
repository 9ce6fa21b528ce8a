"""Sources that are lost, once each: a small version of `scripts/verify I --only hold_sources`."""

from __future__ import annotations

from pathlib import Path

import pytest

from needle_core.process.ros_domain import own_domain
from needle_verification.checking import Workbench
from needle_verification.checks import check_hold_sources
from needle_verification.ros.holds.hold_trials import KINDS, hold_trials
from needle_verification.trials.trial_runner import trials_of
from patience import GENEROUS_MS


def test_each_loss_ends_the_motion_and_nothing_moves_by_itself(tmp_path: Path) -> None:
    with own_domain() as domain:
        seen = list(hold_trials(tmp_path, domain, trials_of(KINDS, (), 1, seed=1)))
    assert [outcome["kind"] for outcome in seen] == list(KINDS)
    for outcome in seen:
        assert outcome["last_motion_ms"] < GENEROUS_MS, outcome
        assert outcome["resumed_mm"] == 0.0, outcome


@pytest.mark.parametrize(
    ("change", "passed"),
    [
        ({}, True),
        ({"last_motion_ms": 170.1}, False),
        ({"resumed_mm": 1e-6}, False),
    ],
)
def test_what_falls_short_is_a_miss(
    change: dict[str, float], passed: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    good = {"moving": 1.0, "last_motion_ms": 120.0, "distance_mm": 0.5, "resumed_mm": 0.0}
    good["silent_ms"] = 20.0
    monkeypatch.setattr(check_hold_sources, "trial_outcomes", lambda *_: [good, {**good, **change}])
    findings = check_hold_sources.hold_sources(Workbench([], tmp_path), 2)
    assert [finding.passed for finding in findings] == [passed] * len(check_hold_sources.WHAT)
