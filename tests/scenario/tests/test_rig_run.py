"""The virtual rig: an undisturbed run converges, a seed gives one run, planted bugs are found."""

from __future__ import annotations

from pathlib import Path

import pytest

from planted_bugs import MENDED, PLANTED
from scenario import rig_run
from scenario.faults import read_schedule
from scenario.rig_run import RunResult, run, schedule_of

SCHEDULES = Path(__file__).parent / "schedules"


def violated(result: RunResult) -> set[str]:
    return {violation.invariant for violation in result.violations}


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the time limits of a run without progress."""
    monkeypatch.setattr(rig_run, "_GO_ON", 15.0)
    monkeypatch.setattr(rig_run, "_DRAW_OUT", 15.0)


def test_an_undisturbed_run_converges() -> None:
    result = run(100, schedule_of(100))
    assert not result.faults
    assert result.inserted
    assert not result.violations


def test_a_seed_determines_the_run() -> None:
    one, again = (run(3, schedule_of(3)) for _ in range(2))
    assert one.faults
    assert run(3, one.relative_to_moments).digest == again.digest == one.digest


@pytest.mark.parametrize("seed", range(2, 14))
def test_faults_violate_nothing(seed: int) -> None:
    result = run(seed, schedule_of(seed))
    assert result.faults
    assert not result.violations


def test_each_schedule_has_its_bug() -> None:
    assert {path.stem for path in SCHEDULES.glob("*.json")} == set(MENDED)


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("name", MENDED)
def test_a_fixed_violation_returns_only_with_its_bug(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    schedule = read_schedule(SCHEDULES / f"{name}.json")
    result = run(*schedule)
    assert not result.violations
    assert len(result.relative_to_moments) == len(result.faults), "each fault met its moment"
    MENDED[name].plant(monkeypatch)
    assert MENDED[name].invariant in violated(run(*schedule))


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_bug_is_found(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    bug = PLANTED[name]
    bug.plant(monkeypatch)
    faults = schedule_of(bug.seed if bug.faults_of is None else bug.faults_of)
    assert bug.invariant in violated(run(bug.seed, faults))
