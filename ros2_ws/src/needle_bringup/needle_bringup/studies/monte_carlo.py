"""`ros2 run needle_sim monte_carlo`: steers thousands of simulated needles."""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from needle_bringup.studies.cluster import run_parts
from needle_bringup.studies.monte_carlo_options import MonteCarloOptions, parse
from needle_bringup.studies.study_parts import parts_of, results_of, settings_of
from needle_core.commands.cli import EXIT_DONE, JsonValue, run_command, write_json
from needle_core.errors import UserError
from needle_sim.needle.se3 import FloatArray

LABELS = {
    "runs": "runs",
    "converged_at_end": "within 1 mm at the end",
    "converged_last_20": "within 1 mm, last 20 steps",
    "rms_last_20_mm": "last 20 steps, rms [mm]",
    "p95_last_20_mm": "last 20 steps, 95 % [mm]",
    "max_last_20_mm": "last 20 steps, worst [mm]",
    "settle_median_mm": "settled at, median [mm]",
    "settle_p95_mm": "settled at, 95 % [mm]",
    "within_1_mm_point": "within 1 mm of the point",
    "rms_point_mm": "distance from it, rms [mm]",
    "p95_point_mm": "distance from it, 95 % [mm]",
    "max_point_mm": "distance from it, worst [mm]",
    "rotation_mean_deg": "rotation, mean [deg]",
    "rotation_p95_deg": "rotation, 95 % [deg]",
    "missed_runs": "runs that missed",
    "diverged": "  share that diverged",
    "inside_2_sigma": "truth within 2 sigma",
    "inside_3_sigma": "truth within 3 sigma",
    "x_inside_3_sigma": "  of x alone",
    "doubtful_at_end": "called doubtful at the end",
    "trusted_far_off": "  more than 5 mm off, and not",
    "wall_s": "time [s]",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `monte_carlo`; return its exit code."""
    argv = sys.argv[1:] if arguments is None else arguments
    return run_command(lambda: monte_carlo(parse(argv)))


def monte_carlo(options: MonteCarloOptions) -> int:
    """Run a study, print its figures and write its files."""
    parts = parts_of(options)
    witness = parts[0].of_first(2)
    # Compile the code before measuring the time.
    witness.run()
    begin, worked_before = time.perf_counter(), time.process_time()
    steps = settings_of(options).steps
    with tqdm(
        total=sum(len(part.starts) for part in parts) * steps,
        unit="step",
        unit_scale=True,
        delay=1.0,
        leave=False,
        disable=not sys.stderr.isatty(),
    ) as bar:
        if options.scheduler:
            outcomes, worked, differing = run_parts(
                options.scheduler, parts, witness, lambda needles: bar.update(needles * steps)
            )
            for machine in differing:
                print(
                    f"warning: {machine} rounds unlike this machine (another processor?): "
                    "figures may differ in their last digits",
                    file=sys.stderr,
                )
        else:
            outcomes = [part.run(bar.update) for part in parts]
            worked = time.process_time() - worked_before
    results, wall = results_of(parts, outcomes), time.perf_counter() - begin
    result = {**results.figures, "cpu_s": worked, "wall_s": wall}
    print(describe(result))
    if options.csv is not None:
        write_csv(options.csv, results.columns, options.run_options)
    if options.json is not None:
        names = ("controller", "estimator", "law", "planner", "grid", "seed")
        asked: dict[str, JsonValue] = {name: getattr(options, name) for name in names}
        # A study has figures either for the plane or for points.
        write_json(options.json, {**dict.fromkeys(LABELS), **result, **asked})
    return EXIT_DONE


def describe(result: Mapping[str, JsonValue]) -> str:
    """Return the figures of a study as text."""
    lines = []
    for key, label in LABELS.items():
        if key not in result:
            continue
        value = result[key]
        text = f"{value:.4f}" if isinstance(value, float) else "-" if value is None else str(value)
        lines.append(f"{label:28}{text}")
    return "\n".join(lines)


def write_csv(path: Path, columns: Mapping[str, FloatArray], of_all: Mapping[str, str]) -> None:
    """Write one line for each run; `settle_mm` is empty for runs that end outside.

    Parameters
    ----------
    path : Path
        The file.
    columns : mapping of str to ndarray, shape (N,)
        Values of each run.
    of_all : mapping
        Values common to all runs, so that the files of several studies can be joined.

    Raises
    ------
    UserError
        If the file cannot be written.
    """
    try:
        with path.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(["run", *columns, *of_all])
            for number, row in enumerate(np.stack(list(columns.values()), axis=-1)):
                values = (f"{value:.6g}" if np.isfinite(value) else "" for value in row)
                writer.writerow([number, *values, *of_all.values()])
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error


if __name__ == "__main__":
    sys.exit(main())
