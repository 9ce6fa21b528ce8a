"""The soak command: its report after an interruption."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from needle_core.commands.cli import EXIT_INTERRUPTED
from scenario import soak
from scenario.faults import Fault, Kind, read_schedule
from scenario.monitors.invariants import Violation
from scenario.rig_run import RunResult

FAULTS = (Fault("bus", Kind.OFF, 1.0, 1.0, 0.5),)
GOOD = RunResult(1, (), (), (), 12.0)
BAD = RunResult(2, FAULTS, (Violation("estop_stops", 1.0, "it went on"),), FAULTS, 12.0)


@pytest.fixture
def ended(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """End the soak by a signal after two runs, and once more while a schedule is shrunk."""

    def results(_: range) -> Iterator[RunResult]:
        yield GOOD
        yield BAD
        raise AssertionError("no third run expected")

    def shrinking(*_: object) -> None:
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(soak, "results_here", results)
    monkeypatch.setattr(soak, "shrink", shrinking)
    # Background jobs of a shell ignore SIGINT.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ended")
def test_an_interrupted_soak_reports_its_progress(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figures, kept = tmp_path / "soak.json", tmp_path / "failures"
    argv = ["--runs", "9", "--json", str(figures), "--failures", str(kept)]
    assert soak.main(argv) == EXIT_INTERRUPTED
    output = capsys.readouterr().out
    assert "seed 2:\n  1.000 s estop_stops: it went on" in output
    assert "interrupted: 2 of 9 runs, 1 violate" in output
    summary = json.loads(figures.read_text("utf-8"))
    assert (summary["runs"], summary["violations"], summary["faults_injected"]) == (2, 1, 1)
    assert read_schedule(kept / "seed_2.json") == (2, list(FAULTS))
