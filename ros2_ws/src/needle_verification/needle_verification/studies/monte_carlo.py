"""`ros2 run needle_sim monte_carlo`: steers thousands of simulated needles and counts."""

from __future__ import annotations

import csv
import dataclasses
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from needle_common.commands.cli import EXIT_DONE, JsonValue, run_command, write_json
from needle_common.errors import UserError
from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.figures_of_merit import figures
from needle_sim.studies.point_study import point_figures, run_point_study
from needle_sim.studies.point_targets import MovingTargets, random_targets
from needle_sim.studies.start_grids import GRIDS, POINTS
from needle_sim.studies.study import StudySettings, run_study
from needle_verification.studies.monte_carlo_options import MonteCarloOptions, parse
from needle_verification.studies.study_controllers import (
    CURVATURE,
    STEP_LENGTH,
    controller_factory,
    needles_at_a_time,
    point_controller_factory,
)

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
    "doubtful_at_end": "called doubtful at the end",
    "trusted_far_off": "  more than 5 mm off, and not",
    "wall_s": "time [s]",
}


@dataclasses.dataclass(frozen=True)
class Results:
    """Results of all runs.

    Attributes
    ----------
    figures : mapping
        As `monte_carlo --json` has them.
    columns : mapping of str to ndarray, shape (N,)
        By the names of `monte_carlo --csv`.
    """

    figures: Mapping[str, JsonValue]
    columns: Mapping[str, FloatArray]


def settings_of(options: MonteCarloOptions) -> StudySettings:
    """Return what the needles of a study have in common."""
    return StudySettings(
        CURVATURE,
        options.depth,
        STEP_LENGTH,
        options.disturbances,
        options.seed,
        options.turn_delay,
    )


def starts_of(options: MonteCarloOptions) -> FloatArray:
    """Return the starts of a study's needles, (N, 3), x [m], pitch, roll [rad]."""
    count = options.targets or POINTS**3 * options.draws
    if options.initial is not None:
        return np.tile(np.asarray(options.initial), (count, 1))
    grid = "random" if options.targets else options.grid
    draws = -(-count // POINTS**3)
    return GRIDS[grid](options.bounds, draws, options.seed)[:count]


def run_all(
    options: MonteCarloOptions,
    starts: FloatArray,
    on_progress: Callable[[int], None] = lambda _: None,
) -> Results:
    """Steer needles from their starts to the plane x = 0, or to a point each.

    Parameters
    ----------
    options : MonteCarloOptions
        What is asked for.
    starts : ndarray, shape (N, 3)
        Those of `starts_of`, or some of them.
    on_progress : callable
        Told after each step how many needles have made one.
    """
    steer = _to_points if options.targets else _to_plane
    results = steer(options, starts, on_progress)
    x, pitch, roll = starts.T
    columns = {"x_mm": x * 1e3, "pitch_deg": np.rad2deg(pitch), "roll_deg": np.rad2deg(roll)}
    return Results({"runs": len(starts), **results.figures}, {**columns, **results.columns})


def _to_plane(
    options: MonteCarloOptions, starts: FloatArray, on_progress: Callable[[int], None]
) -> Results:
    flips = np.linspace(0.0, options.depth, options.flips + 2)[1:-1].tolist()
    outcomes = run_study(
        starts,
        controller_factory(
            options.controller,
            options.claimed_bound,
            flips,
            sigma_scale=options.sigma_scale,
            turn_delay=options.turn_delay,
        ),
        settings_of(options),
        on_progress=on_progress,
        chunk=needles_at_a_time(options.controller),
    )
    last = np.abs(outcomes.x_last) * 1e3
    return Results(
        {**figures(outcomes), "missed_runs": int(np.sum(~outcomes.converged_at_end))},
        {
            "r1_final_mm": outcomes.x_end * 1e3,
            "rms_last_20_mm": np.sqrt(np.mean(last**2, axis=1)),
            "max_last_20_mm": np.max(last, axis=1),
            "settle_mm": outcomes.settled * 1e3,
            "rotation_deg": np.rad2deg(outcomes.rotation),
            "diverged": outcomes.diverged.astype(float),
        },
    )


def _to_points(
    options: MonteCarloOptions, starts: FloatArray, on_progress: Callable[[int], None]
) -> Results:
    places = random_targets(starts, CURVATURE, options.seed)
    outcomes = run_point_study(
        starts,
        MovingTargets(places, options.target_drift, options.target_breath, options.seed),
        point_controller_factory(
            options.controller,
            options.claimed_bound,
            sigma_scale=options.sigma_scale,
            rotation_budget=options.rotation_budget,
        ),
        settings_of(options),
        on_progress=on_progress,
    )
    x, y, z = places.T * 1e3
    return Results(
        {**point_figures(outcomes), "missed_runs": int(np.sum(~outcomes.reached))},
        {
            "target_x_mm": x,
            "target_y_mm": y,
            "target_z_mm": z,
            "error_mm": outcomes.error * 1e3,
            "rotation_deg": np.rad2deg(outcomes.rotation),
        },
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `monte_carlo`; returns its exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    return run_command(lambda: monte_carlo(parse(words)))


def monte_carlo(options: MonteCarloOptions) -> int:
    """Run a study as asked, print its figures and write its files."""
    starts = starts_of(options)
    # What is compiled is compiled now, not in the time that is reported.
    run_all(options, starts[:2])
    begin, worked_before = time.perf_counter(), time.process_time()
    with tqdm(
        total=len(starts) * settings_of(options).steps,
        unit="step",
        unit_scale=True,
        delay=1.0,
        leave=False,
        disable=not sys.stderr.isatty(),
    ) as bar:
        results = run_all(options, starts, bar.update)
    worked, wall = time.process_time() - worked_before, time.perf_counter() - begin
    seen = {**results.figures, "cpu_s": worked, "wall_s": wall}
    print(describe(seen))
    if options.csv is not None:
        write_csv(options.csv, results.columns)
    if options.json is not None:
        asked: dict[str, JsonValue] = {
            "controller": options.controller,
            "grid": options.grid,
            "seed": options.seed,
        }
        # Of a plane there are no figures of points, and the other way round.
        write_json(options.json, {**dict.fromkeys(LABELS), **seen, **asked})
    return EXIT_DONE


def describe(result: Mapping[str, JsonValue]) -> str:
    """Return a study's figures as a person reads them."""
    lines = []
    for key, label in LABELS.items():
        if key not in result:
            continue
        value = result[key]
        text = f"{value:.4f}" if isinstance(value, float) else "-" if value is None else str(value)
        lines.append(f"{label:28}{text}")
    return "\n".join(lines)


def write_csv(path: Path, columns: Mapping[str, FloatArray]) -> None:
    """Write one line for each run; `settle_mm` is empty where a run ends outside.

    Raises
    ------
    UserError
        If the file cannot be written.
    """
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
