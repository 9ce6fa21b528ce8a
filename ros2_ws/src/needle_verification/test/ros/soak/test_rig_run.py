"""The virtual rig: an undisturbed run converges, a seed gives one run, planted bugs are found."""

from __future__ import annotations

from pathlib import Path

import pytest

from needle_verification.ros.soak.rig_run import RunResult, run, schedule_of
from needle_verification.soak.faults import read_schedule
from planted_bugs import PLANTED

SCHEDULES = Path(__file__).parent / "schedules"


def violated(result: RunResult) -> set[str]:
    return {violation.invariant for violation in result.violations}


def test_an_undisturbed_run_converges_and_a_seed_gives_one_run() -> None:
    one = run(20, schedule_of(20))
    assert not one.faults
    assert one.inserted
    assert not one.violations
    assert run(20, []).digest == one.digest


@pytest.mark.parametrize("seed", range(2, 14))
def test_faults_violate_nothing(seed: int) -> None:
    result = run(seed, schedule_of(seed))
    assert result.faults
    assert not result.violations


@pytest.mark.parametrize("path", sorted(SCHEDULES.glob("*.json")), ids=lambda path: path.stem)
def test_what_once_violated_does_not_any_more(path: Path) -> None:
    assert not run(*read_schedule(path)).violations


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_bug_is_found(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    bug = PLANTED[name]
    bug.plant(monkeypatch)
    assert bug.invariant in violated(run(bug.seed, schedule_of(bug.seed)))
