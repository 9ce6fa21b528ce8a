"""`scripts/bench`: every speed and memory figure with its reference from the same run."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Iterator, Sequence

from campaign.benchmarks import (
    drive_benchmark,
    latency_benchmark,
    link_benchmark,
    recording_benchmark,
    study_benchmark,
    tracker_benchmark,
)
from campaign.benchmarks.figure_rows import Row
from child_processes import ending_descendants
from needle_core.commands.cli import EXIT_DONE, JsonValue, run_command, write_json
from needle_core.commands.options import CommandParser, output_file
from needle_core.errors import UserError

DESCRIPTION = """\
Measure speed and memory, each figure with a reference from the same run: their ratio is independent
of the machine's speed.
"""
EPILOG = """\
references:
  plain Python     the same loop per needle with numbers and `math` (few needles, scaled)
  python-control   the same loop as interconnected systems of python-control (fewer, scaled); its
                   time per update includes the simulation of the needle
  rosbags Writer   the same messages into an MCAP bag; the disk alone: their bytes into one file;
                   both including fsync
  a frame          period of the exposures at 30 Hz
  pyigtl           the same OpenIGTLink transforms by pyigtl's server
  one at a time    the code of the study in a loop over needles (few needles, scaled)

exit codes: 0 done; 2 invalid input; 130 interrupted
"""
BENCHES: dict[str, Callable[[], Iterator[Row]]] = {
    "studies": study_benchmark.studies,
    "updates": study_benchmark.updates,
    "memory": study_benchmark.memory,
    "tracker": tracker_benchmark.rows,
    "recording": recording_benchmark.writer_rows,
    "reception": recording_benchmark.reception_rows,
    "drives": drive_benchmark.rows,
    "latency": latency_benchmark.rows,
    "link": link_benchmark.rows,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bench`; return its exit code."""
    return run_command(lambda: _bench(sys.argv[1:] if arguments is None else arguments))


def _bench(arguments: Sequence[str]) -> int:
    parser = CommandParser("bench", DESCRIPTION, EPILOG)
    parser.add_argument("--json", metavar="FILE", help="also write the figures as flat JSON")
    parser.add_argument("--only", metavar="WORD", help="only rows whose name contains this")
    given = parser.parse_args(arguments)
    file = output_file("--json", given.json)
    benches = {name: bench for name, bench in BENCHES.items() if (given.only or "") in name}
    if not benches:
        raise UserError(f"--only {given.only!r} is not in {', '.join(BENCHES)}")
    values: dict[str, JsonValue] = {}
    print(f"{'':34}{'here':>12}  {'reference':>12}  {'ratio':>8}")
    with ending_descendants():
        for row in itertools.chain.from_iterable(bench() for bench in benches.values()):
            print(
                f"{row.what:34}{row.value:10.4g} {row.unit:2} {row.reference:10.4g} {row.unit:2} "
                f"{row.ratio:7.3g}x  {row.against}",
                flush=True,
            )
            unit = row.unit.replace("%", "percent")
            values[f"{row.key}_{unit}"] = row.value
            name = row.against.replace(" ", "_").replace("-", "_").replace(",", "").lower()
            values[f"{row.key}_{name}_{unit}"] = row.reference
            values[f"{row.key}_{name}_ratio"] = row.ratio
    if file is not None:
        write_json(file, values)
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
