"""The soak: many runs of the virtual rig under faults, and the shortest way to each violation."""

from __future__ import annotations

import argparse
import gc
import itertools
import multiprocessing
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from needle_common.commands.cli import EXIT_DONE, EXIT_MISSED, run_command, write_json
from needle_common.errors import UserError
from needle_verification.ros.soak.process_run import run_processes
from needle_verification.ros.soak.rig_run import RunResult, run, schedule_of
from needle_verification.soak.faults import Fault, read_schedule, write_schedule
from needle_verification.soak.invariants import Violation
from needle_verification.soak.shrinking import shrink

HELP = """\
Run the whole rig many times in simulated time, under random faults, and check its invariants.

Each run has all nodes of the rig in one process, on one clock and one seed: driver with emulated
drives, controller, operator, a person, and up to six faults (nodes killed, stopped, slow; topics,
services and bus lossy, late, silent; drives, cameras, clocks and people that fail). The same seed
gives the same run. The schedule of a run that violates an invariant is shortened, and kept as a
file with --failures.

With --processes, runs of real processes follow, in real time, one after the other: nodes are killed
and stopped while a simulated needle is inserted. They need an otherwise idle machine.
"""
EXAMPLES = """\
examples:
  scripts/soak --runs 300                300 runs
  scripts/soak --runs 1 --seed 4711      repeat the run of one seed
  scripts/soak --runs 300 --processes 3  then three of real processes, some 25 s each
  scripts/soak --schedule FILE           replay a schedule that an earlier run kept

exit codes: 0 no invariant violated, 1 at least one violated, 2 bad input, 130 interrupted.
"""


def main(arguments: list[str] | None = None) -> int:
    """Run the soak; returns its exit code."""
    return run_command(lambda: _soak(_options(arguments)))


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="scripts/soak",
        description=HELP,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--runs", type=int, default=300, metavar="N", help="number of runs (300)")
    parser.add_argument(
        "--processes", type=int, default=0, metavar="N", help="number of runs of real processes (0)"
    )
    parser.add_argument(
        "--seed", type=int, default=1, metavar="S", help="seed of the first run (1)"
    )
    parser.add_argument(
        "--schedule", type=Path, metavar="FILE", help="replay the seed and faults in this file"
    )
    parser.add_argument(
        "--failures", type=Path, metavar="DIR", help="keep schedules that violate here"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures as JSON")
    return parser.parse_args(arguments)


def _soak(options: argparse.Namespace) -> int:
    for name, count in (("--runs", options.runs), ("--processes", options.processes)):
        if count < 0:
            raise UserError(f"{name} {count}: at least 0")
    if options.runs == options.processes == 0:
        raise UserError("--runs 0 and no --processes: nothing to do")
    begin = time.monotonic()
    processes = 0
    if options.schedule is not None:
        results: Iterator[RunResult] = iter([run(*read_schedule(options.schedule))])
        runs = 1
    else:
        runs, processes = options.runs, options.processes
        first = options.seed
        results = itertools.chain(
            _results(range(first, first + runs)),
            _process_results(range(first, first + processes), options.failures),
        )
    violations = faults = 0
    simulated = 0.0
    for number, result in enumerate(results, start=1):
        faults += len(result.told_by_moments)
        simulated += result.simulated
        if result.violations:
            violations += 1
            _tell(result, options.failures)
        if sys.stderr.isatty():
            text = f"\r{number} of {runs + processes} runs, {violations} violate"
            print(text, end="", file=sys.stderr)
    figures = {
        "runs": runs,
        "processes": processes,
        "violations": violations,
        "faults_injected": faults,
        "simulated_hours": simulated / 3600.0,
        "wall_s": time.monotonic() - begin,
    }
    of_processes = f" and {processes} of processes" if processes else ""
    print(
        f"{runs} runs{of_processes}, {faults} faults, {figures['simulated_hours']:.2f} simulated "
        f"hours in {figures['wall_s']:.0f} s: {violations} violate"
    )
    if options.json is not None:
        write_json(options.json, figures)
    return EXIT_MISSED if violations else EXIT_DONE


def _results(seeds: range) -> Iterator[RunResult]:
    if not seeds:
        return
    # Fresh interpreters: a fork would share what numerical libraries keep for their threads.
    workers = min(len(seeds), os.cpu_count() or 1)
    with multiprocessing.get_context("spawn").Pool(workers, _begin_worker) as pool:
        yield from pool.imap(_run_seed, seeds)


def _process_results(seeds: range, folder: Path | None) -> Iterator[RunResult]:
    for seed in seeds:
        with tempfile.TemporaryDirectory(prefix="needle_soak_") as name:
            result = run_processes(seed, Path(name))
            if result.violations and folder is not None:
                shutil.copytree(name, folder / f"processes_{seed}", dirs_exist_ok=True)
            yield result


def _begin_worker() -> None:
    os.environ.update({"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"})
    # Each run is collected at its end; what is imported stays, and need not be looked at.
    gc.freeze()
    gc.disable()


def _run_seed(seed: int) -> RunResult:
    return run(seed, schedule_of(seed))


def _tell(result: RunResult, folder: Path | None) -> None:
    if result.of_processes:
        # Real time cannot be had again: as it was, not shrunk.
        _print(f"processes, seed {result.seed}", result.violations, result.faults)
        return
    names = {one.invariant for one in result.violations}

    def still(faults: list[Any]) -> bool:
        return bool(names & {one.invariant for one in run(result.seed, faults).violations})

    kept = shrink(result.faults, still)
    told = list(run(result.seed, kept).told_by_moments)
    if still(told):
        kept = told
    _print(f"seed {result.seed}", result.violations, kept)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        why = "; ".join(f"{one.invariant}: {one.text}" for one in result.violations)
        write_schedule(folder / f"seed_{result.seed}.json", result.seed, kept, why)


def _print(run_name: str, violations: Iterable[Violation], faults: Iterable[Fault]) -> None:
    print(f"\n{run_name}:")
    for violation in violations:
        print(f"  {violation.at:.3f} s {violation.invariant}: {violation.text}")
    for fault in faults:
        print(f"    {fault}")


if __name__ == "__main__":
    sys.exit(main())
