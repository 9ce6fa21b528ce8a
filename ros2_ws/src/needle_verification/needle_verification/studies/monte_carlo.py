"""`ros2 run needle_sim monte_carlo`: steers thousands of simulated needles and counts."""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from needle_common.commands.cli import EXIT_DONE, JsonValue, run_command, write_json
from needle_common.errors import UserError
from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.figures_of_merit import Outcomes, figures
from needle_sim.studies.start_grids import GRIDS, POINTS
from needle_sim.studies.study import StudySettings, run_study
from needle_verification.studies.monte_carlo_options import MonteCarloOptions, parse
from needle_verification.studies.study_controllers import CURVATURE, STEP_LENGTH, controller_factory

LABELS = {
    "runs": "runs",
    "converged_at_end": "within 1 mm at the end",
    "converged_last_20": "within 1 mm, last 20 steps",
    "rms_last_20_mm": "last 20 steps, rms [mm]",
    "p95_last_20_mm": "last 20 steps, 95 % [mm]",
    "max_last_20_mm": "last 20 steps, worst [mm]",
    "settle_median_mm": "settled at, median [mm]",
    "settle_p95_mm": "settled at, 95 % [mm]",
    "rotation_mean_deg": "rotation, mean [deg]",
    "missed_runs": "runs that missed",
    "diverged": "  share that diverged",
    "wall_s": "time [s]",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `monte_carlo`; returns its exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    return run_command(lambda: monte_carlo(parse(words)))


def monte_carlo(options: MonteCarloOptions) -> int:
    """Run a study as asked, print its figures and write its files."""
    settings = StudySettings(
        CURVATURE, options.depth, STEP_LENGTH, options.disturbances, options.seed
    )
    flips = np.linspace(0.0, options.depth, options.flips + 2)[1:-1].tolist()
    new_controller = controller_factory(options.controller, options.disturbances.noise, flips)
    # What is compiled is compiled now, not in the time that is reported.
    run_study(np.zeros((2, 3)), new_controller, settings)
    begin, worked_before = time.perf_counter(), time.process_time()
    if options.initial is None:
        starts = GRIDS[options.grid](options.bounds, options.draws, options.seed)
    else:
        starts = np.tile(np.asarray(options.initial), (POINTS**3 * options.draws, 1))
    with tqdm(
        total=len(starts) * settings.steps,
        unit="step",
        unit_scale=True,
        delay=1.0,
        leave=False,
        disable=not sys.stderr.isatty(),
    ) as bar:
        outcomes = run_study(starts, new_controller, settings, on_progress=bar.update)
    result: dict[str, JsonValue] = {"runs": len(starts), **figures(outcomes)}
    result["missed_runs"] = int(np.sum(~outcomes.converged_at_end))
    result["cpu_s"] = time.process_time() - worked_before
    result["wall_s"] = time.perf_counter() - begin
    print(describe(result))
    if options.csv is not None:
        write_csv(options.csv, starts, outcomes)
    if options.json is not None:
        result |= {"controller": options.controller, "grid": options.grid, "seed": options.seed}
        write_json(options.json, result)
    return EXIT_DONE


def describe(result: Mapping[str, JsonValue]) -> str:
    """Return a study's figures as a person reads them."""
    lines = []
    for key, label in LABELS.items():
        value = result[key]
        text = f"{value:.4f}" if isinstance(value, float) else "-" if value is None else str(value)
        lines.append(f"{label:28}{text}")
    return "\n".join(lines)


def write_csv(path: Path, starts: FloatArray, outcomes: Outcomes) -> None:
    """Write one line for each run; `settle_mm` is empty where a run ends outside.

    Raises
    ------
    UserError
        If the file cannot be written.
    """
    last = np.abs(outcomes.x_last) * 1e3
    columns = {
        "x_mm": starts[:, 0] * 1e3,
        "pitch_deg": np.rad2deg(starts[:, 1]),
        "roll_deg": np.rad2deg(starts[:, 2]),
        "r1_final_mm": outcomes.x_end * 1e3,
        "rms_last_20_mm": np.sqrt(np.mean(last**2, axis=1)),
        "max_last_20_mm": np.max(last, axis=1),
        "settle_mm": outcomes.settled * 1e3,
        "rotation_deg": np.rad2deg(outcomes.rotation),
        "diverged": outcomes.diverged.astype(float),
    }
    try:
        with path.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(columns)
            for row in np.stack(list(columns.values()), axis=-1):
                writer.writerow(f"{value:.6g}" if np.isfinite(value) else "" for value in row)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error


if __name__ == "__main__":
    sys.exit(main())
