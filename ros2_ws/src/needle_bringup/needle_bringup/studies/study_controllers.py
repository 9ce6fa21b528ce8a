"""Controllers for studies: the estimators and laws of needle_controller.

The studies are in needle_sim, which does not import the controller under test.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from needle_bringup.studies.study_estimators import (
    BestEstimators,
    Estimators,
    PaperObservers,
    PoseEstimators,
    SeparateEstimators,
)
from needle_bringup.studies.study_laws import (
    PointLaws,
    best_point_laws,
    best_rates,
    each_point_law,
    each_rate,
    planned_law,
    rrt_law,
    sliding_law,
)
from needle_controller.laws.law import LinearizingLaw
from needle_controller.model.arrays import Array
from needle_controller.model.target_motion import TargetMotion
from needle_controller.observers.estimator import Estimator
from needle_controller.presets.point_steering import PointSteering
from needle_controller.presets.presets import (
    filter_settings,
    make_controller,
    make_law,
    observer_settings,
)
from needle_controller.presets.steering_settings import ONE_SIDED_PRESETS, PRESETS, SteeringSettings
from needle_controller.protocol.confidence import point_miss_probability
from needle_core.errors import UserError
from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.figures_of_merit import Belief
from needle_sim.studies.study import CHUNK

SLIDING_MODE, RRT = "sliding_mode", "rrt"
"""Names of the reference laws for points."""
CURVATURE = SteeringSettings.curvature
STEP_LENGTH = SteeringSettings.step_length
# The linear observer needs a twentieth of the filter's memory.
_LINEAR_CHUNK = 20 * CHUNK
# Depth in the controller's settings, at their upper limit, as a study has its own depth [m].
_DEEPEST = 1.0


class SteeredNeedles:
    """Estimators and laws, called as in the node; implements `study.Controller`.

    Parameters
    ----------
    new_estimators : callable
        Returns the estimators, given the number of needles.
    rates : callable
        Returns the rotation rates, (N,) [rad/m], given the estimators and an inserted length [m].
    covariance : ndarray, shape (3, 3), optional
        Claimed covariance of each tip [m^2]; by default the estimator's own assumption.
    turn_delay : float
        See `study.StudySettings`.
    """

    def __init__(
        self,
        new_estimators: Callable[[int], Estimators],
        rates: Callable[[Any, float], FloatArray],
        covariance: Array | None = None,
        turn_delay: float = 0.0,
    ) -> None:
        self._new_estimators = new_estimators
        self._rates = rates
        self._covariance = covariance
        self._turn_delay = turn_delay
        self._estimators: Estimators | None = None
        self._insertion: FloatArray = np.zeros(())
        self._turned: FloatArray = np.zeros(())

    def start(self, tips: FloatArray) -> FloatArray:
        """Handle the first measured tips; see `study.Controller.start`."""
        self._estimators = self._new_estimators(len(tips))
        self._estimators.start(np.ascontiguousarray(tips))
        self._insertion = self._turned = np.zeros(len(tips))
        return self._rates(self._estimators, 0.0)

    def step(
        self,
        d_insertion: float | FloatArray,
        d_rotation: FloatArray,
        tips: FloatArray,
        age: float | FloatArray,
    ) -> FloatArray:
        """Handle a step and the tips measured after it; see `study.Controller.step`."""
        assert self._estimators is not None
        lengths = np.array(np.broadcast_to(d_insertion, len(tips)))
        self._insertion = self._insertion + lengths
        self._turned = self._turned + np.abs(d_rotation)
        if self._turn_delay > 0.0:
            unturned = np.minimum(self._turn_delay, 0.9 * lengths)
            self._estimators.advance(unturned, 0.0 * d_rotation)
            lengths -= unturned
        self._estimators.advance(lengths, d_rotation)
        ages = np.array(np.broadcast_to(age, len(tips)))
        self._estimators.correct(np.ascontiguousarray(tips), self._covariance, ages)
        return self._rates(self._estimators, float(np.max(self._insertion)))

    def belief(self) -> Belief | None:
        """Return the estimates after the last step; see `study.Controller.belief`."""
        if self._estimators is None:
            return None
        return self._estimators.belief()


class NeedlesToPoints(SteeredNeedles):
    """Estimators, and laws for points; implements `point_study.PointController`.

    Parameters
    ----------
    new_estimators, covariance :
        See `SteeredNeedles`.
    new_laws : callable
        Returns the laws, given the motion of the targets.
    rotation_budget : float
        Maximum total rotation of each base [rad].
    """

    def __init__(
        self,
        new_estimators: Callable[[int], PoseEstimators],
        new_laws: Callable[[TargetMotion], PointLaws],
        covariance: Array | None = None,
        rotation_budget: float = math.inf,
    ) -> None:
        self._motion = TargetMotion()
        self._point_laws = new_laws(self._motion)
        self._rotation_budget = rotation_budget
        self._left: FloatArray = np.full((), np.nan)
        super().__init__(new_estimators, self._command, covariance)

    def set_targets(self, time: float, targets: FloatArray) -> None:
        """Handle the positions of the targets; see `point_study.PointController`."""
        self._motion.observe(time, targets)

    def insertion_left(self) -> FloatArray:
        """Return the remaining insertion of each needle; see `point_study.PointController`."""
        return self._left

    def belief(self) -> Belief | None:
        """Return the estimates after the last step; a miss refers to the point."""
        belief = super().belief()
        if belief is None or belief.missed is None:
            return belief
        assert isinstance(self._estimators, PoseEstimators)
        tips, covariances = self._estimators.tips()
        missed = point_miss_probability(tips - self._motion.last, covariances)
        return dataclasses.replace(belief, missed=missed)

    def _command(self, estimators: Any, _: float) -> FloatArray:
        rates, self._left = self._point_laws(
            estimators, self._insertion, self._rotation_budget - self._turned
        )
        return rates


def needles_at_a_time(name: str) -> int:
    """Return the number of needles of a preset that fit into the cache."""
    return _LINEAR_CHUNK if name in ONE_SIDED_PRESETS else CHUNK


def controller_factory(
    name: str,
    claimed: float,
    flip_depths: Sequence[float] = (),
    *,
    sigma_scale: float = 1.0,
    turn_delay: float = 0.0,
    own: Mapping[str, Any] = {},
    first: int = 0,
) -> Callable[[], SteeredNeedles]:
    """Return a factory of the controller of a group of needles.

    Parameters
    ----------
    name : str
        One of `PRESETS`.
    claimed : float
        Claimed maximum error of a measured coordinate [m].
    flip_depths : sequence of float
        Insertions at which the bevel is flipped, mirrored, in ascending order [m].
    sigma_scale : float
        If it is not 1, each tip has a covariance instead of the bound, with the standard deviations
        of uniform noise within `claimed`, divided by this.
    turn_delay : float
        See `study.StudySettings` [m].
    own : mapping
        Settings `estimator`, `law`, `planner` from other packages, and `seed`.
    first : int
        Number of the first needle, which seeds the random numbers of an external estimator.

    Raises
    ------
    UserError
        If there is no such controller, or it cannot flip.
    """
    settings, covariance = _claimed_settings(name, claimed, sigma_scale, flip_depths, own)
    if name in ONE_SIDED_PRESETS and not settings.estimator and not settings.law:
        known, law = observer_settings(settings), make_law(settings)
        weights = law.gains if isinstance(law, LinearizingLaw) else None
        return lambda: SteeredNeedles(
            lambda count: PaperObservers(known, count),
            lambda observers, _: observers.rates(weights),
            turn_delay=turn_delay,
        )
    rates: Callable[[Any, float], FloatArray] = best_rates(settings)
    if settings.estimator or settings.law or name in ONE_SIDED_PRESETS:
        rates = each_rate(lambda _: make_controller(settings, np.eye(3))[1])
    return lambda: SteeredNeedles(new_estimators(settings, first), rates, covariance, turn_delay)


def new_estimators(settings: SteeringSettings, first: int) -> Callable[[int], PoseEstimators]:
    """Return a factory of the estimators of needles, numbered from `first`."""
    if settings.preset == "best" and not settings.estimator:
        known = filter_settings(settings)
        return lambda count: BestEstimators(known, count, settings.step_length)

    def new(n: int) -> Estimator:
        return make_controller(settings, np.eye(3), np.zeros(3), number=first + n)[0]

    return lambda _: SeparateEstimators(new)


def point_controller_factory(
    name: str,
    claimed: float,
    *,
    sigma_scale: float = 1.0,
    rotation_budget: float = math.inf,
    own: Mapping[str, Any] = {},
    first: int = 0,
) -> Callable[[], NeedlesToPoints]:
    """Return a factory of the controller of a group of needles that are steered to points.

    Parameters and errors are those of `controller_factory`. A preset that does not estimate the
    whole pose is rejected; the reference laws use the estimator of `best`. `rotation_budget` is the
    maximum total rotation of each base [rad]; the reference laws ignore it.
    """
    preset = "best" if name in {SLIDING_MODE, RRT} else name
    settings, covariance = _claimed_settings(preset, claimed, sigma_scale, (), own)
    settings.check_steers_to_points()

    def new_laws(motion: TargetMotion) -> PointLaws:
        if name == RRT:
            rng = np.random.default_rng(1)
            return each_point_law(motion, lambda own_motion: rrt_law(own_motion, settings, rng))
        if name == SLIDING_MODE:
            largest = settings.max_rotation_per_length
            return each_point_law(motion, lambda own_motion: sliding_law(own_motion, largest))
        if settings.planner:
            return each_point_law(motion, lambda own_motion: planned_law(own_motion, settings))
        if settings.estimator or settings.law:
            return each_point_law(
                motion, lambda own_motion: PointSteering(settings, own_motion).command
            )
        return best_point_laws(settings, motion)

    return lambda: NeedlesToPoints(
        new_estimators(settings, first), new_laws, covariance, rotation_budget
    )


def _claimed_settings(
    name: str,
    claimed: float,
    sigma_scale: float,
    flip_depths: Sequence[float],
    own: Mapping[str, Any],
) -> tuple[SteeringSettings, Array | None]:
    if name not in PRESETS:
        raise UserError(f"--controller {name!r} is not available; choose from {', '.join(PRESETS)}")
    settings = SteeringSettings(
        preset=name,
        tip_covariance="configured" if sigma_scale == 1.0 else "from_tip_pose",
        tip_noise="bounded",
        tip_noise_bound=claimed,
        measurement_std=claimed / math.sqrt(3.0),
        depth=_DEEPEST,
        flip_depths=tuple(flip_depths),
        **own,
    )
    if sigma_scale == 1.0:
        return settings, None
    return settings, np.asarray(np.eye(3) * (settings.measurement_std / sigma_scale) ** 2)
