"""The soak: many runs of the virtual rig under faults, and the shortest way to each violation."""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from needle_common.commands.cli import EXIT_DONE, EXIT_MISSED, run_command, write_json
from needle_common.errors import UserError
from needle_verification.ros.soak.rig_run import RunResult, run, schedule_of
from needle_verification.soak.faults import read_schedule, write_schedule
from needle_verification.soak.shrinking import shrink

HELP = """\
Run the whole rig many times in simulated time, under random faults; watch what must always hold.

Each run has all nodes of the rig in one process, on one clock and one seed: driver with emulated
drives, controller, operator, a person, and up to six faults (nodes killed, stopped, slow; topics,
services and bus lossy, late, silent; drives, cameras, clocks and people that fail). The same seed
gives the same run. A run that violates an invariant is shrunk and kept as a file.
"""
EXAMPLES = """\
examples:
  scripts/soak --runs 300                300 runs
  scripts/soak --runs 1 --seed 4711      that run again
  scripts/soak --schedule FILE           what a file of an earlier run tells

exit codes: 0 nothing was violated, 1 something was, 2 bad input, 130 interrupted.
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
    parser.add_argument("--runs", type=int, default=300, metavar="N", help="how many (300)")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="of the first run (1)")
    parser.add_argument("--schedule", type=Path, metavar="FILE", help="seed and faults of one run")
    parser.add_argument(
        "--failures", type=Path, metavar="DIR", help="where schedules that violate are kept"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures as JSON")
    return parser.parse_args(arguments)


def _soak(options: argparse.Namespace) -> int:
    if options.runs < 1:
        raise UserError(f"--runs {options.runs}: at least 1")
    begin = time.monotonic()
    if options.schedule is not None:
        results: Iterator[RunResult] = iter([run(*read_schedule(options.schedule))])
        count = 1
    else:
        count = options.runs
        results = _results(range(options.seed, options.seed + count))
    violations = faults = 0
    simulated = 0.0
    for number, result in enumerate(results, start=1):
        faults += len(result.faults)
        simulated += result.simulated
        if result.violations:
            violations += 1
            _tell(result, options.failures)
        if sys.stderr.isatty():
            print(f"\r{number} of {count} runs, {violations} violate", end="", file=sys.stderr)
    figures = {
        "runs": count,
        "processes": 0,
        "violations": violations,
        "faults_injected": faults,
        "simulated_hours": simulated / 3600.0,
        "wall_s": time.monotonic() - begin,
    }
    print(
        f"{count} runs, {faults} faults, {figures['simulated_hours']:.2f} simulated hours in "
        f"{figures['wall_s']:.0f} s: {violations} violate"
    )
    if options.json is not None:
        write_json(options.json, figures)
    return EXIT_MISSED if violations else EXIT_DONE


def _results(seeds: range) -> Iterator[RunResult]:
    # Fresh interpreters: a fork would share what numerical libraries keep for their threads.
    workers = min(len(seeds), os.cpu_count() or 1)
    with multiprocessing.get_context("spawn").Pool(workers, _keep_to_one_thread) as pool:
        yield from pool.imap(_run_seed, seeds)


def _keep_to_one_thread() -> None:
    os.environ.update({"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"})


def _run_seed(seed: int) -> RunResult:
    return run(seed, schedule_of(seed))


def _tell(result: RunResult, folder: Path | None) -> None:
    names = {one.invariant for one in result.violations}

    def still(faults: list[Any]) -> bool:
        return bool(names & {one.invariant for one in run(result.seed, faults).violations})

    kept = shrink(result.faults, still)
    print(f"\nseed {result.seed}:")
    for violation in result.violations:
        print(f"  {violation.at:.3f} s {violation.invariant}: {violation.text}")
    for fault in kept:
        print(f"    {fault}")
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        why = "; ".join(f"{one.invariant}: {one.text}" for one in result.violations)
        write_schedule(folder / f"seed_{result.seed}.json", result.seed, kept, why)


if __name__ == "__main__":
    sys.exit(main())
