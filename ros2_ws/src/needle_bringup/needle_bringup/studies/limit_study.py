"""The limit beside the result: what a filter that knows the true model makes of the same needles.

python -m needle_bringup.studies.limit_study
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable, Collection
from typing import Any

import numpy as np

from needle_bringup.studies.particle_filter import ParticleFilter
from needle_bringup.studies.study_controllers import (
    CURVATURE,
    STEP_LENGTH,
    NeedlesToPoints,
    SteeredNeedles,
    controller_factory,
    point_controller_factory,
)
from needle_bringup.studies.study_estimators import EachEstimator, Estimators
from needle_bringup.studies.study_laws import PointLaws, each_point_law, each_rate
from needle_controller.model.target_motion import TargetMotion
from needle_controller.presets.point_steering import PointSteering
from needle_controller.presets.presets import make_controller
from needle_controller.presets.steering_settings import PAPER_NOISE, SteeringSettings
from needle_core.commands.cli import EXIT_DONE
from needle_sim.studies.disturbances import Disturbances
from needle_sim.studies.point_study import (
    FARTHEST,
    MovingTargets,
    PointController,
    random_targets,
    run_point_study,
)
from needle_sim.studies.study import (
    GRIDS,
    POINTS,
    Controller,
    StartBounds,
    StudySettings,
    run_study,
)

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
    law = make_controller(settings, np.eye(3))[1]

    def by_law(motion: TargetMotion) -> PointLaws:
        return each_point_law(motion, lambda own: PointSteering(settings, own).command)

    rows = {}
    for label in only:
        wrong = ROWS[label]
        rngs = np.random.default_rng(seed).spawn(needles)

        def knowing(_: int, wrong: Disturbances = wrong, rngs: Any = rngs) -> Estimators:
            return EachEstimator(
                lambda n: ParticleFilter(CURVATURE, wrong, BOUNDS, particles, rngs[n])
            )

        rows[label] = LimitRow(
            best=_reached(
                wrong,
                needles,
                seed,
                controller_factory("best", settings.tip_noise_bound),
                point_controller_factory("best", settings.tip_noise_bound),
            ),
            limit=_reached(
                wrong,
                needles,
                seed,
                lambda: SteeredNeedles(knowing, each_rate(lambda _: law)),
                lambda: NeedlesToPoints(knowing, by_law),
            ),
        )
    return rows


def _reached(
    wrong: Disturbances,
    needles: int,
    seed: int,
    to_plane: Callable[[], Controller],
    to_points: Callable[[], PointController],
) -> Reached:
    """Steer needles to the plane and to points."""
    starts = GRIDS["random"](BOUNDS, -(-needles // POINTS**3), seed)[:needles]
    in_plane = run_study(
        starts, to_plane, StudySettings(CURVATURE, DEPTH, STEP_LENGTH, wrong, seed), chunk=needles
    )
    at_points = run_point_study(
        starts,
        MovingTargets(random_targets(starts, CURVATURE, seed)),
        to_points,
        StudySettings(CURVATURE, DEPTH_OF_POINTS, STEP_LENGTH, wrong, seed),
        chunk=needles,
    )
    return Reached(
        rms_mm=float(np.sqrt(np.mean(in_plane.x_last**2))) * 1e3,
        point_rms_mm=float(np.sqrt(np.mean(at_points.error**2))) * 1e3,
        point_share=float(np.mean(at_points.reached)),
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
