"""The limit beside the result: what a filter that knows the true model makes of the same needles.

python -m needle_bringup.studies.limit_study
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable, Collection
from functools import partial

import numpy as np

from needle_bringup.studies.particle_filter import ParticleFilter
from needle_bringup.studies.study_controllers import (
    CURVATURE,
    STEP_LENGTH,
    NeedlesToPoints,
    SteeredNeedles,
)
from needle_controller.observers.estimator import Estimator
from needle_controller.presets.point_steering import PointSteering
from needle_controller.presets.presets import make_controller
from needle_controller.presets.steering_settings import PAPER_NOISE, SteeringSettings
from needle_core.commands.cli import EXIT_DONE
from needle_sim.studies.disturbances import Disturbances
from needle_sim.studies.point_study import run_point_study
from needle_sim.studies.point_targets import FARTHEST, MovingTargets, random_targets
from needle_sim.studies.start_grids import GRIDS, POINTS, StartBounds
from needle_sim.studies.study import CHUNK, StudySettings, run_study

NEEDLES, PARTICLES = 200, 2000
BOUNDS = StartBounds(x=0.003, pitch=math.radians(10.0), roll=math.radians(30.0))
DEPTH, DEPTH_OF_POINTS = FARTHEST, 0.15
NOISE = 0.001
ROWS = {
    "noise as claimed": Disturbances(noise=NOISE),
    "normal noise of the same variance": Disturbances(
        noise=NOISE / math.sqrt(3.0), noise_shape="normal"
    ),
    "5 % outliers of 2-3.5 mm": Disturbances(
        noise=NOISE, outliers=0.05, outlier_size=(0.002, 0.0035)
    ),
    "play 40 deg": Disturbances(noise=NOISE, play=math.radians(40.0)),
    "lag 8 mm": Disturbances(noise=NOISE, lag_length=0.008),
}
_CHUNK = 25
"""Needles with all their particles that are steered at a time."""


@dataclasses.dataclass(frozen=True)
class Reached:
    """Results of some needles.

    Attributes
    ----------
    rms_mm : float
        Of the distance from the plane over the last 20 steps.
    point_rms_mm, point_share : float
        Of the distance from the points at the end, and the share within 1 mm.
    """

    rms_mm: float
    point_rms_mm: float
    point_share: float


@dataclasses.dataclass(frozen=True)
class LimitRow:
    """The same needles, steered by preset `best` and by a filter that knows the true model."""

    best: Reached
    limit: Reached


def limits(
    needles: int, particles: int, seed: int, only: Collection[str] = tuple(ROWS)
) -> dict[str, LimitRow]:
    """Return what is reached under each of `ROWS`.

    Parameters
    ----------
    needles, particles : int
        How many, and how many for each needle.
    seed : int
        Of all randomness.
    only : collection of str
        Which of `ROWS`; all by default.
    """
    settings = SteeringSettings(**PAPER_NOISE)
    rows = {}
    for label in only:
        wrong = ROWS[label]
        key = wrong, needles, seed
        rows[label] = LimitRow(
            best=_reached(key, partial(_best, settings), settings, CHUNK),
            limit=_reached(
                key,
                partial(ParticleFilter, CURVATURE, wrong, BOUNDS, particles, seed),
                settings,
                _CHUNK,
            ),
        )
    return rows


def _best(settings: SteeringSettings) -> Estimator:
    return make_controller(settings, np.eye(3), np.zeros(3))[0]


def _reached(
    key: tuple[Disturbances, int, int],
    new_estimator: Callable[[], Estimator],
    settings: SteeringSettings,
    chunk: int,
) -> Reached:
    """Steer needles with an estimator and the laws of `best`, to the plane and to points."""
    wrong, needles, seed = key
    starts = GRIDS["random"](BOUNDS, -(-needles // POINTS**3), seed)[:needles]
    law = make_controller(settings, np.eye(3))[1]
    to_plane = run_study(
        starts,
        lambda: SteeredNeedles(new_estimator(), law),
        StudySettings(CURVATURE, DEPTH, STEP_LENGTH, wrong, seed),
        chunk=chunk,
    )
    to_points = run_point_study(
        starts,
        MovingTargets(random_targets(starts, CURVATURE, seed)),
        lambda: NeedlesToPoints(
            new_estimator(), lambda motion: PointSteering(settings, motion).command
        ),
        StudySettings(CURVATURE, DEPTH_OF_POINTS, STEP_LENGTH, wrong, seed),
        chunk=chunk,
    )
    return Reached(
        rms_mm=float(np.sqrt(np.mean(to_plane.x_last**2))) * 1e3,
        point_rms_mm=float(np.sqrt(np.mean(to_points.error**2))) * 1e3,
        point_share=float(np.mean(to_points.reached)),
    )


def main() -> int:
    """Print the limits beside what `best` reaches."""
    for label in ROWS:
        (row,) = limits(NEEDLES, PARTICLES, 1, (label,)).values()
        for name, reached in (("best", row.best), ("limit", row.limit)):
            print(
                f"{label:36s} {name:6s} {reached.rms_mm:.3f} mm  {reached.point_rms_mm:.3f} mm  "
                f"{100.0 * reached.point_share:.1f} %",
                flush=True,
            )
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
