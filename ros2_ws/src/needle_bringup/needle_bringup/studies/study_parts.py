"""Division of a study into independent groups of needles, and their results.

Random numbers are seeded by the needle, and those of an external estimator by the part, so that the
outcomes of a part do not depend on where or when it runs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from needle_bringup.studies.monte_carlo_options import MonteCarloOptions
from needle_bringup.studies.study_controllers import (
    CURVATURE,
    controller_factory,
    needles_at_a_time,
    point_controller_factory,
)
from needle_core.commands.cli import JsonValue
from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.figures_of_merit import Outcomes, concatenate, figures, is_doubtful
from needle_sim.studies.point_study import (
    MovingTargets,
    PointOutcomes,
    point_figures,
    random_targets,
    run_point_study,
)
from needle_sim.studies.study import GRIDS, POINTS, StudySettings, run_study

# Options that are passed on as settings of the controller.
_OWN = ("estimator", "law", "planner", "seed", "step_length")


@dataclasses.dataclass(frozen=True, eq=False)
class StudyPart:
    """Group of needles of a study that are steered together.

    Attributes
    ----------
    options : MonteCarloOptions
        Options of the study.
    first : int
        Number of the first needle.
    starts : ndarray, shape (N, 3)
        Initial x [m], pitch and roll [rad] of each needle.
    points : ndarray, shape (N, 3)
        Target point of each needle [m]; (0, 3) if the target is the plane.
    """

    options: MonteCarloOptions
    first: int
    starts: FloatArray
    points: FloatArray

    def of_first(self, count: int) -> StudyPart:
        """Return a part with only the first needles of this one."""
        return dataclasses.replace(
            self, starts=self.starts[:count].copy(), points=self.points[:count].copy()
        )

    def run(self, on_progress: Callable[[int], None] = lambda _: None) -> Outcomes | PointOutcomes:
        """Steer the needles; `on_progress` is called after each step with their number."""
        options = self.options
        controller: dict[str, Any] = {
            "sigma_scale": options.sigma_scale,
            "own": {name: getattr(options, name) for name in _OWN},
            "first": self.first,
        }
        study: dict[str, Any] = {
            "on_progress": on_progress,
            "chunk": len(self.starts),
            "first": self.first,
        }
        if options.targets:
            targets = MovingTargets(
                self.points, options.target_drift, options.target_breath, options.seed, self.first
            )
            new_point_controller = point_controller_factory(
                options.controller,
                options.claimed_bound,
                rotation_budget=options.rotation_budget,
                **controller,
            )
            return run_point_study(
                self.starts, targets, new_point_controller, settings_of(options), **study
            )
        flips = np.linspace(0.0, options.depth, options.flips + 2)[1:-1].tolist()
        new_controller = controller_factory(
            options.controller,
            options.claimed_bound,
            flips,
            turn_delay=options.turn_delay,
            **controller,
        )
        return run_study(self.starts, new_controller, settings_of(options), **study)


@dataclasses.dataclass(frozen=True)
class Results:
    """Results of all runs.

    Attributes
    ----------
    figures : mapping
        Content of `monte_carlo --json`.
    columns : mapping of str to ndarray, shape (N,)
        Columns of `monte_carlo --csv`.
    """

    figures: Mapping[str, JsonValue]
    columns: Mapping[str, FloatArray]


def settings_of(options: MonteCarloOptions) -> StudySettings:
    """Return the settings common to all needles of a study."""
    return StudySettings(
        CURVATURE,
        options.depth,
        options.step_length,
        options.disturbances,
        options.seed,
        options.turn_delay,
    )


def parts_of(options: MonteCarloOptions) -> list[StudyPart]:
    """Return the parts of a study, in the order of its needles."""
    starts = _starts(options)
    points: FloatArray = np.empty((0, 3))
    if options.targets:
        points = random_targets(starts, CURVATURE, options.seed)
    size = needles_at_a_time(options.controller)
    return [
        StudyPart(
            options, first, starts[first : first + size].copy(), points[first : first + size].copy()
        )
        for first in range(0, len(starts), size)
    ]


def results_of(parts: Sequence[StudyPart], outcomes: Sequence[Outcomes | PointOutcomes]) -> Results:
    """Return the results of a study from the outcomes of its parts, in order."""
    x, pitch, roll = np.concatenate([part.starts for part in parts]).T
    begun = {"x_mm": x * 1e3, "pitch_deg": np.rad2deg(pitch), "roll_deg": np.rad2deg(roll)}
    whole = concatenate(outcomes)
    if isinstance(whole, PointOutcomes):
        ended = _of_points(whole, np.concatenate([part.points for part in parts]))
    else:
        ended = _of_plane(whole)
    return Results({"runs": len(x), **ended.figures}, {**begun, **ended.columns})


def _starts(options: MonteCarloOptions) -> FloatArray:
    count = options.targets or POINTS**3 * options.draws
    if options.initial is not None:
        return np.tile(np.asarray(options.initial), (count, 1))
    grid = "random" if options.targets else options.grid
    draws = -(-count // POINTS**3)
    return GRIDS[grid](options.bounds, draws, options.seed)[:count]


def _of_plane(outcomes: Outcomes) -> Results:
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
            "inside_3_sigma": outcomes.inside_3_sigma,
            "x_inside_3_sigma": outcomes.x_inside_3_sigma,
            "doubtful": is_doubtful(outcomes.missed),
            "stated_miss": outcomes.missed,
        },
    )


def _of_points(outcomes: PointOutcomes, points: FloatArray) -> Results:
    x, y, z = points.T * 1e3
    return Results(
        {**point_figures(outcomes), "missed_runs": int(np.sum(~outcomes.reached))},
        {
            "target_x_mm": x,
            "target_y_mm": y,
            "target_z_mm": z,
            "error_mm": outcomes.error * 1e3,
            "rotation_deg": np.rad2deg(outcomes.rotation),
            "inside_3_sigma": outcomes.inside_3_sigma,
            "doubtful": is_doubtful(outcomes.missed),
        },
    )
