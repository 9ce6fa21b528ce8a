"""Laws for the needles of a study: any kind one by one, or `best` in compiled loops."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from needle_bringup.studies.study_estimators import PoseEstimators
from needle_controller.laws.law import SteeringCommand, StepLaw
from needle_controller.laws.point_turns import PointLawSettings
from needle_controller.laws.roll_law import RollLawSettings, bend_sign
from needle_controller.many_needles import ManyFilters
from needle_controller.model.target_motion import TargetMotion
from needle_controller.model.target_plane import offset_plane
from needle_controller.observers.estimator import Estimate
from needle_controller.planning.obstacles import Obstacles
from needle_controller.presets.path_steering import PathSteering
from needle_controller.presets.point_steering import ArrivalPrediction
from needle_controller.presets.steering_settings import SteeringSettings
from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.point_study import INSERTION_SPEED
from needle_sim.studies.reference_laws import SAMPLES, DutyCycle, plan, sliding_mode_rate

TimedLaw = Callable[[Estimate, float, float, float], SteeringCommand]
"""Maps an estimate, time [s], insertion [m] and remaining rotation [rad] to a command."""

CLEAR = 0.00085
"""Clearance of the published planner: the needle's radius plus 0.5 mm [m]."""

PointLaws = Callable[[Any, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""Maps estimators, inserted lengths [m] and remaining rotations [rad], (N,), to rotation rates
[rad/m] and remaining insertions [m], (N,)."""


def each_rate(new_law: Callable[[int], StepLaw]) -> Callable[[PoseEstimators, float], FloatArray]:
    """Return a function for the rotation rates from laws that are called one by one."""
    laws: list[StepLaw] = []

    def rates(estimators: PoseEstimators, insertion: float) -> FloatArray:
        known = estimators.each()
        laws.extend(new_law(n) for n in range(len(laws), len(known)))
        return np.array(
            [law(one, insertion).rotation_rate for law, one in zip(laws, known, strict=True)]
        )

    return rates


def each_point_law(motion: TargetMotion, new_law: Callable[[TargetMotion], TimedLaw]) -> PointLaws:
    """Return laws for points that are called one by one.

    Parameters
    ----------
    motion : TargetMotion
        Motion of all targets.
    new_law : callable
        Returns the law of a needle, given the motion of its target.
    """
    laws: list[tuple[TargetMotion, TimedLaw]] = []

    def commands(
        estimators: PoseEstimators, insertion: FloatArray, rotation_left: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        known = estimators.each()
        for _ in range(len(laws), len(known)):
            own = TargetMotion()
            laws.append((own, new_law(own)))
        targets = np.broadcast_to(motion.last, (len(known), 3))
        rates, left = np.empty(len(known)), np.empty(len(known))
        for n, (own, law) in enumerate(laws):
            own.observe(motion.last_time, targets[n])
            inserted = float(insertion[n])
            command = law(known[n], inserted / INSERTION_SPEED, inserted, float(rotation_left[n]))
            assert command.insertion_left is not None
            rates[n], left[n] = command.rotation_rate, command.insertion_left
        return rates, left

    return commands


def best_rates(settings: SteeringSettings) -> Callable[[ManyFilters, float], FloatArray]:
    """Return a function for the rotation rates from the law of `best`, in compiled loops."""
    law = RollLawSettings(**settings.turning)

    def rates(filters: ManyFilters, insertion: float) -> FloatArray:
        return filters.roll_rates(law, bend_sign(settings.flip_depths, insertion))

    return rates


def best_point_laws(settings: SteeringSettings, motion: TargetMotion) -> PointLaws:
    """Return the law of `best` for points, in compiled loops."""
    law, prediction = PointLawSettings(**settings.turning), ArrivalPrediction(motion)

    def commands(
        filters: ManyFilters, insertion: FloatArray, rotation_left: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        def left(targets: FloatArray) -> FloatArray:
            return filters.point_rates(law, targets, rotation_left)[1]

        targets = prediction.predict(insertion / INSERTION_SPEED, insertion, left)
        return filters.point_rates(law, targets, rotation_left)

    return commands


def sliding_law(motion: TargetMotion, largest_rate: float) -> TimedLaw:
    """Return the published reference law towards the current target; see `sliding_mode`.

    Parameters
    ----------
    motion : TargetMotion
        Motion of the target.
    largest_rate : float
        Maximum rotation per inserted length [rad/m].
    """

    def command(estimate: Estimate, *_: float) -> SteeringCommand:
        target = estimate.rotation.T @ (motion.last - estimate.position)
        rate = float(sliding_mode_rate(target, largest_rate))
        return SteeringCommand(0.0, rate, float(target[2]))

    return command


def rrt_law(motion: TargetMotion, settings: SteeringSettings, rng: np.random.Generator) -> TimedLaw:
    """Return the published planner as a law that plans at every step; see `rrt_replanning`.

    Parameters
    ----------
    motion : TargetMotion
        Motion of the target.
    settings : SteeringSettings
        Settings of the needle.
    rng : numpy.random.Generator
        Random numbers of the planner.
    """
    free = np.zeros((0, 7))
    cycle = DutyCycle(settings.max_rotation_per_length, settings.step_length)

    def command(estimate: Estimate, *_: float) -> SteeringCommand:
        ahead = estimate.rotation.T @ (motion.last - estimate.position)
        # Default if no path is found: the tightest arc towards the target.
        arc = np.array([ahead[0], ahead[1], 1.0])
        plan(
            np.array(estimate.position),
            np.ascontiguousarray(estimate.rotation),
            np.array(motion.last),
            free,
            settings.curvature,
            CLEAR,
            rng.random((SAMPLES, 4)),
            arc,
        )
        return SteeringCommand(0.0, float(cycle.rates(arc[None])[0]), float(ahead[2]))

    return command


def planned_law(motion: TargetMotion, settings: SteeringSettings) -> TimedLaw:
    """Return the law that follows the path of a planner, without obstacles.

    Parameters
    ----------
    motion : TargetMotion
        Motion of the target.
    settings : SteeringSettings
        Settings of the needle, including the planner.
    """
    needle, free, plane = PathSteering(settings), Obstacles(), offset_plane(0.0)
    # Without a path the needle stops.
    stop = SteeringCommand(0.0, 0.0, -math.inf)

    def command(estimate: Estimate, _: float, insertion: float, __: float) -> SteeringCommand:
        return needle.command(estimate, plane, motion.last, free, insertion) or stop

    return command
