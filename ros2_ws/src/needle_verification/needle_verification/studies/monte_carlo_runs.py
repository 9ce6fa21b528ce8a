"""What `monte_carlo` runs: needles to the plane, or to points, and what became of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Protocol

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


class Runs(Protocol):
    """A study that is ready to run; `starts` are its needles', (N, 3)."""

    starts: FloatArray
    settings: StudySettings

    def compile(self) -> None:
        """Run a needle or two, so that what is compiled is compiled."""

    def run(self, on_progress: Callable[[int], None]) -> Results:
        """Run it; told after each step how many needles have made one."""


class PlaneRuns:
    """A study of needles that are steered to the plane x = 0.

    Parameters
    ----------
    options : MonteCarloOptions
        What is asked for.
    """

    def __init__(self, options: MonteCarloOptions) -> None:
        self.settings = _settings(options)
        self.starts = _starts(options, POINTS**3 * options.draws)
        flips = np.linspace(0.0, options.depth, options.flips + 2)[1:-1].tolist()
        self._new_controller = controller_factory(
            options.controller, options.claimed_bound, flips, sigma_scale=options.sigma_scale
        )
        self._chunk = needles_at_a_time(options.controller)

    def compile(self) -> None:
        """Run two needles; see `Runs.compile`."""
        run_study(np.zeros((2, 3)), self._new_controller, self.settings)

    def run(self, on_progress: Callable[[int], None]) -> Results:
        """Run the study; see `Runs.run`."""
        outcomes = run_study(
            self.starts,
            self._new_controller,
            self.settings,
            on_progress=on_progress,
            chunk=self._chunk,
        )
        last = np.abs(outcomes.x_last) * 1e3
        return Results(
            {
                "runs": len(self.starts),
                **figures(outcomes),
                "missed_runs": int(np.sum(~outcomes.converged_at_end)),
            },
            {
                **_columns_of_starts(self.starts),
                "r1_final_mm": outcomes.x_end * 1e3,
                "rms_last_20_mm": np.sqrt(np.mean(last**2, axis=1)),
                "max_last_20_mm": np.max(last, axis=1),
                "settle_mm": outcomes.settled * 1e3,
                "rotation_deg": np.rad2deg(outcomes.rotation),
                "diverged": outcomes.diverged.astype(float),
            },
        )


class PointRuns:
    """A study of needles that are steered to a point each.

    Parameters
    ----------
    options : MonteCarloOptions
        What is asked for.
    """

    def __init__(self, options: MonteCarloOptions) -> None:
        self.settings = _settings(options)
        self.starts = _starts(options, options.targets)
        places = random_targets(self.starts, CURVATURE, options.seed)
        self._targets = MovingTargets(
            places, options.target_drift, options.target_breath, options.seed
        )
        self._new_controller = point_controller_factory(
            options.controller, options.claimed_bound, sigma_scale=options.sigma_scale
        )

    def compile(self) -> None:
        """Run two needles; see `Runs.compile`."""
        ahead = MovingTargets(np.tile([0.0, 0.0, 0.01], (2, 1)))
        run_point_study(np.zeros((2, 3)), ahead, self._new_controller, self.settings)

    def run(self, on_progress: Callable[[int], None]) -> Results:
        """Run the study; see `Runs.run`."""
        outcomes = run_point_study(
            self.starts,
            self._targets,
            self._new_controller,
            self.settings,
            on_progress=on_progress,
        )
        x, y, z = self._targets.places.T * 1e3
        return Results(
            {
                "runs": len(self.starts),
                **point_figures(outcomes),
                "missed_runs": int(np.sum(~outcomes.reached)),
            },
            {
                **_columns_of_starts(self.starts),
                "target_x_mm": x,
                "target_y_mm": y,
                "target_z_mm": z,
                "error_mm": outcomes.error * 1e3,
                "rotation_deg": np.rad2deg(outcomes.rotation),
            },
        )


def _settings(options: MonteCarloOptions) -> StudySettings:
    return StudySettings(CURVATURE, options.depth, STEP_LENGTH, options.disturbances, options.seed)


def _starts(options: MonteCarloOptions, count: int) -> FloatArray:
    if options.initial is not None:
        return np.tile(np.asarray(options.initial), (count, 1))
    grid = "random" if options.targets else options.grid
    draws = -(-count // POINTS**3)
    return GRIDS[grid](options.bounds, draws, options.seed)[:count]


def _columns_of_starts(starts: FloatArray) -> dict[str, FloatArray]:
    return {
        "x_mm": starts[:, 0] * 1e3,
        "pitch_deg": np.rad2deg(starts[:, 1]),
        "roll_deg": np.rad2deg(starts[:, 2]),
    }
