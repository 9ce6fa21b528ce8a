"""Runs of `monte_carlo`: needles to the plane, or to points, and what became of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np

from needle_common.commands.cli import JsonValue
from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.figures_of_merit import figures
from needle_sim.studies.point_study import point_figures, run_point_study
from needle_sim.studies.point_targets import MovingTargets, random_targets
from needle_sim.studies.start_grids import GRIDS, POINTS
from needle_sim.studies.study import StudySettings, run_study
from needle_verification.studies.monte_carlo_options import MonteCarloOptions
from needle_verification.studies.study_controllers import (
    CURVATURE,
    STEP_LENGTH,
    controller_factory,
    needles_at_a_time,
    point_controller_factory,
)


@dataclasses.dataclass(frozen=True)
class Results:
    """What became of all runs.

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
    return StudySettings(CURVATURE, options.depth, STEP_LENGTH, options.disturbances, options.seed)


def starts_of(options: MonteCarloOptions) -> FloatArray:
    """Return the starts of a study's needles, (N, 3), x [m], pitch, roll [rad]."""
    count = options.targets or POINTS**3 * options.draws
    if options.initial is not None:
        return np.tile(np.asarray(options.initial), (count, 1))
    grid = "random" if options.targets else options.grid
    draws = -(-count // POINTS**3)
    return GRIDS[grid](options.bounds, draws, options.seed)[:count]


def run(
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
            options.controller, options.claimed_bound, flips, sigma_scale=options.sigma_scale
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
            options.controller, options.claimed_bound, sigma_scale=options.sigma_scale
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
