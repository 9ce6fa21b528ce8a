"""Run the whole rig many times in simulated time under random faults, and check its invariants.

Each run has all nodes of the rig in one process, with one clock and one seed: driver with emulated
drives, controller, operator, a simulated person, and up to six faults (nodes killed, stopped or
slow; topics, services and bus lossy, late or silent; failures of drives, cameras, clocks and the
person). The same seed gives the same run. If a run violates an invariant, its schedule of faults is
shortened, and written to a file with --failures. An interrupted soak prints its progress.

With --processes, runs of real processes follow in real time: nodes are killed and stopped during
the insertion of a simulated needle. They need an otherwise idle machine.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from needle_core.commands.cli import (
    EXIT_DONE,
    EXIT_INTERRUPTED,
    EXIT_MISSED,
    run_command,
    write_json,
)
from needle_core.errors import UserError
from scenario.faults import Fault, read_schedule, write_schedule
from scenario.many_runs import Tally, results_here, results_of_cluster
from scenario.monitors.invariants import Violation
from scenario.process_run import results_of_processes
from scenario.rig_run import RunResult, run
from scenario.shrinking import shrink

EXAMPLES = """\
examples:
  scripts/soak --runs 300                300 runs
  scripts/soak --runs 1 --seed 4711      repeat the run of one seed
  scripts/soak --runs 300 --processes 3  then three runs of real processes, about 25 s each
  scripts/soak --runs 10000 --scheduler tcp://10.0.0.5:8786
  scripts/soak --schedule FILE           replay a schedule of --failures

exit codes: 0 no invariant violated; 1 at least one violated; 2 invalid input; 130 interrupted
"""


def main(arguments: list[str] | None = None) -> int:
    """Run the soak; returns its exit code."""
    return run_command(lambda: _soak(_options(arguments)))


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="scripts/soak",
        description=__doc__,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    cluster = (
        "run on the Dask cluster of this scheduler, such as tcp://10.0.0.5:8786, with the same "
        "results (docs/several_computers.md)"
    )
    for name, kind, default, metavar, text in (
        ("--runs", int, 300, "N", "number of runs (300)"),
        ("--processes", int, 0, "N", "number of runs of real processes (0)"),
        ("--seed", int, 1, "S", "seed of the first run (1)"),
        ("--schedule", Path, None, "FILE", "replay the seed and the faults of this file"),
        ("--failures", Path, None, "DIR", "write schedules of violations into this folder"),
        ("--scheduler", str, "", "ADDRESS", cluster),
        ("--json", Path, None, "FILE", "also write the figures as flat JSON"),
    ):
        parser.add_argument(name, type=kind, default=default, metavar=metavar, help=text)
    return parser.parse_args(arguments)


def _soak(options: argparse.Namespace) -> int:
    for name, count in (("--runs", options.runs), ("--processes", options.processes)):
        if count < 0:
            raise UserError(f"{name} {count}: at least 0")
    if options.runs == options.processes == 0:
        raise UserError("--runs 0 and no --processes: nothing to do")
    if options.schedule is not None:
        tally = Tally(1, 0)
        seed, faults = read_schedule(options.schedule)
        results: Iterator[RunResult] = (run(seed, faults) for _ in range(1))
    else:
        tally = Tally(options.runs, options.processes)
        seeds = range(options.seed, options.seed + options.runs)
        processes = range(options.seed, options.seed + options.processes)
        results = itertools.chain(
            results_of_cluster(options.scheduler, seeds)
            if options.scheduler
            else results_here(seeds),
            results_of_processes(processes, options.failures),
        )
    interrupted = False
    try:
        for result in results:
            tally.add(result)
            if result.violations:
                _report(result, options.failures)
            if sys.stderr.isatty():
                print(f"\r{tally.progress}", end="", file=sys.stderr)
    except KeyboardInterrupt:
        # An interrupted soak reports the finished runs.
        interrupted = True
    if interrupted:
        print(f"interrupted: {tally.progress}")
    print(tally.line)
    write_json(options.json, tally.figures)
    if interrupted:
        return EXIT_INTERRUPTED
    return EXIT_MISSED if tally.violations else EXIT_DONE


def _report(result: RunResult, folder: Path | None) -> None:
    if result.of_processes:
        # Real time is not repeatable, so the schedule is not shrunk.
        _print_violations(f"processes, seed {result.seed}", result.violations)
        _print_faults(result.faults)
        return
    why = "; ".join(f"{one.invariant}: {one.text}" for one in result.violations)
    names = {one.invariant for one in result.violations}

    def keep(faults: Sequence[Fault]) -> None:
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            write_schedule(folder / f"seed_{result.seed}.json", result.seed, faults, why)

    def still(faults: list[Any]) -> bool:
        return bool(names & {one.invariant for one in run(result.seed, faults).violations})

    # Shrinking takes minutes, and may be interrupted.
    _print_violations(f"seed {result.seed}", result.violations)
    keep(result.faults)
    kept = shrink(result.faults, still)
    relative = list(run(result.seed, kept).relative_to_moments)
    if still(relative):
        kept = relative
    _print_faults(kept)
    keep(kept)


def _print_violations(run_name: str, violations: Iterable[Violation]) -> None:
    print(f"\n{run_name}:")
    for violation in violations:
        print(f"  {violation.at:.3f} s {violation.invariant}: {violation.text}")


def _print_faults(faults: Iterable[Fault]) -> None:
    for fault in faults:
        print(f"    {fault}")


if __name__ == "__main__":
    sys.exit(main())
