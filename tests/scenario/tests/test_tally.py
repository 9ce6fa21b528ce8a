"""What was asked for, what is done, and what is said of it."""

from __future__ import annotations

from scenario.tally import Tally


def test_runs_are_counted_by_their_kind() -> None:
    tally = Tally(3, 2)
    tally.add(of_processes=False, faults=4, simulated=1800.0, violates=False)
    tally.add(of_processes=False, faults=2, simulated=1800.0, violates=True)
    tally.add(of_processes=True, faults=1, simulated=0.0, violates=False)
    figures = tally.figures
    assert figures.pop("wall_s") >= 0.0
    assert figures == {
        "runs": 2, "processes": 1, "violations": 1, "faults_injected": 7, "simulated_hours": 1.0,
    }  # fmt: skip
    assert tally.progress == "3 of 5 runs, 1 violate"
    assert tally.line.startswith("2 runs and 1 of processes, 7 faults, 1.00 simulated hours in ")
    assert tally.line.endswith(": 1 violate")
