"""Runs of many seeds in order, on all cores or on a cluster, and their totals."""

from __future__ import annotations

import functools
import gc
import itertools
import multiprocessing
import os
import signal
import tempfile
import threading
import time
from collections.abc import Iterator

from tqdm import tqdm

from needle_bringup.studies.cluster import on_cluster
from scenario.rig_run import RunResult, run, schedule_of

# Runs in one task of a cluster, about ten seconds.
_PART = 10


class Tally:
    """Totals of the finished runs.

    Parameters
    ----------
    runs, processes : int
        Number of requested runs, in simulated time and of real processes.

    Attributes
    ----------
    violations : int
        Number of runs that violated an invariant.
    """

    def __init__(self, runs: int, processes: int) -> None:
        self._asked = runs + processes
        self._begin = time.monotonic()
        self._runs = self._processes = self._faults = 0
        self._simulated = 0.0
        self.violations = 0

    def add(self, result: RunResult) -> None:
        """Add a run."""
        self._runs += not result.of_processes
        self._processes += result.of_processes
        self._faults += len(result.relative_to_moments)
        self._simulated += result.simulated
        self.violations += bool(result.violations)

    @property
    def progress(self) -> str:
        """Progress as text."""
        done = self._runs + self._processes
        return f"{done} of {self._asked} runs, {self.violations} violate"

    @property
    def figures(self) -> dict[str, float]:
        """Figures of the finished runs."""
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
        """The figures as one line."""
        at = self.figures
        of_processes = f" and {self._processes} of processes" if self._processes else ""
        return (
            f"{self._runs} runs{of_processes}, {self._faults} faults, {at['simulated_hours']:.2f} "
            f"simulated hours in {at['wall_s']:.0f} s: {self.violations} violate"
        )


def results_here(seeds: range) -> Iterator[RunResult]:
    """Yield the results of seeds, run on all cores."""
    if not seeds:
        return
    # Fresh interpreters: a fork would share thread state of numerical libraries.
    workers = min(len(seeds), len(os.sched_getaffinity(0)))
    context = multiprocessing.get_context("spawn")
    # A folder for all workers, because a killed worker leaves its files.
    with (
        tempfile.TemporaryDirectory(prefix="needle_soak_") as folder,
        context.Pool(workers, _init_worker, (folder,)) as pool,
    ):
        yield from pool.imap(_run_seed, seeds)


def results_of_cluster(address: str, seeds: range) -> Iterator[RunResult]:
    """Yield the results of seeds, run by the workers of a scheduler; see `on_cluster`."""
    parts = [seeds[first : first + _PART] for first in range(0, len(seeds), _PART)]
    yield from itertools.chain.from_iterable(on_cluster(address, run_part, parts))


def run_part(seeds: range) -> list[RunResult]:
    """Run some seeds, on a worker."""
    _prepare_process()
    return [_run_seed(seed) for seed in seeds]


def _init_worker(folder: str) -> None:
    tempfile.tempdir = folder
    os.environ.update({"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"})
    # The default lock of tqdm is a semaphore, which a killed worker would leave behind.
    tqdm.set_lock(threading.RLock())
    # Ctrl-C reaches the whole group, but the parent ends the workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _prepare_process()


@functools.lru_cache(maxsize=1)
def _prepare_process() -> None:
    """Prepare this process for runs, once."""
    # Exclude imported modules from garbage collection.
    gc.freeze()


def _run_seed(seed: int) -> RunResult:
    try:
        return run(seed, schedule_of(seed))
    except Exception as error:
        raise RuntimeError(f"the run of seed {seed} broke: {error!r}") from error
