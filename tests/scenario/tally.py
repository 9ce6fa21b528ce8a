"""Sums of a soak: runs that are done, what went wrong in them, and how long they took."""

from __future__ import annotations

import time

from scenario.rig_run import RunResult


class Tally:
    """Counts runs as they end.

    Parameters
    ----------
    runs, processes : int
        How many were asked for, in simulated time and of real processes.

    Attributes
    ----------
    violations : int
        Runs that violated an invariant.
    """

    def __init__(self, runs: int, processes: int) -> None:
        self._asked = runs + processes
        self._begin = time.monotonic()
        self._runs = self._processes = self._faults = 0
        self._simulated = 0.0
        self.violations = 0

    def add(self, result: RunResult) -> None:
        """Count a run."""
        self._runs += not result.of_processes
        self._processes += result.of_processes
        self._faults += len(result.told_by_moments)
        self._simulated += result.simulated
        self.violations += bool(result.violations)

    @property
    def progress(self) -> str:
        """Progress, as a person reads it."""
        done = self._runs + self._processes
        return f"{done} of {self._asked} runs, {self.violations} violate"

    @property
    def figures(self) -> dict[str, float]:
        """Figures of the runs that are done."""
        return {
            "runs": self._runs,
            "processes": self._processes,
            "violations": self.violations,
            "faults_injected": self._faults,
            "simulated_hours": self._simulated / 3600.0,
            "wall_s": time.monotonic() - self._begin,
        }

    @property
    def line(self) -> str:
        """The figures in a line."""
        at = self.figures
        of_processes = f" and {self._processes} of processes" if self._processes else ""
        return (
            f"{self._runs} runs{of_processes}, {self._faults} faults, {at['simulated_hours']:.2f} "
            f"simulated hours in {at['wall_s']:.0f} s: {self.violations} violate"
        )
