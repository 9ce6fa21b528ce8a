"""The controllers a study can ask for: needle_controller's own estimators and laws, unchanged.

needle_sim, whose studies these are for, does not know the controller under test.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from needle_controller.laws.law import SteeringCommand, StepLaw
from needle_controller.laws.roll_law import hypotheses_of
from needle_controller.model.arrays import Array
from needle_controller.model.target_motion import TargetMotion
from needle_controller.model.target_plane import offset_plane
from needle_controller.observers.estimator import Estimate, Estimator
from needle_controller.observers.luenberger import LuenbergerObserver
from needle_controller.planning.obstacles import Obstacles
from needle_controller.presets.path_steering import PathSteering, tip_states
from needle_controller.presets.point_steering import PointSteering, prompt_point_law
from needle_controller.presets.presets import make_controller
from needle_controller.presets.steering_settings import (
    ONE_SIDED_PRESETS,
    PRESETS,
    SteeringSettings,
)
from needle_controller.protocol.trust import ends_elsewhere
from needle_core.errors import UserError
from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.beliefs import Belief
from needle_sim.studies.point_targets import INSERTION_SPEED
from needle_sim.studies.rrt_replanning import SAMPLES, DutyCycle, plan
from needle_sim.studies.sliding_mode import sliding_mode_rate
from needle_sim.studies.study import CHUNK

TimedLaw = Callable[[Estimate, FloatArray, FloatArray, FloatArray], SteeringCommand]

SLIDING_MODE, RRT = "sliding_mode", "rrt"
"""Names of the reference laws for points."""
CLEAR = 0.00085
"""What the published planner keeps from obstacles: the needle's radius and half a mm [m]."""
CURVATURE = SteeringSettings.curvature
STEP_LENGTH = SteeringSettings.step_length
# What the linear observer knows of a needle is a twentieth of what the bank does.
_LINEAR_CHUNK = 20 * CHUNK
# Studies have depths of their own; what limits flips here is what the settings take [m].
_DEEPEST = 1.0


class SteeredNeedles:
    """An estimator and a law, called as the node calls them: what `study.Controller` describes.

    Parameters
    ----------
    estimator : Estimator
        For as many needles as there will be tips.
    law : callable
        Returns the command for an estimate at an inserted length [m].
    covariance : ndarray, shape (3, 3), optional
        What each tip's is said to be [m^2]; the estimator's own assumption if none is given.
    turn_delay : float
        See `study.StudySettings`: the joints tell.
    """

    def __init__(
        self,
        estimator: Estimator,
        law: StepLaw,
        covariance: Array | None = None,
        turn_delay: float = 0.0,
    ) -> None:
        self._turn_delay = turn_delay
        self._estimator = estimator
        self._law = law
        self._covariance = covariance
        self._insertion: FloatArray = np.zeros(())
        self._turned: FloatArray = np.zeros(())
        self._estimate: Estimate | None = None

    def start(self, tips: FloatArray) -> FloatArray:
        """Take the first measured tips; see `study.Controller.start`."""
        self._estimator.reset(tips, np.zeros((len(tips), 2)))
        return self._rate()

    def step(
        self,
        d_insertion: float | FloatArray,
        d_rotation: FloatArray,
        tips: FloatArray,
        age: float | FloatArray,
    ) -> FloatArray:
        """Take a step and what was measured after it; see `study.Controller.step`."""
        self._insertion = self._insertion + d_insertion
        self._turned = self._turned + np.abs(d_rotation)
        if self._turn_delay > 0.0:
            unturned = np.minimum(self._turn_delay, 0.9 * np.asarray(d_insertion))
            self._estimator.advance(unturned, 0.0 * d_rotation)
            d_insertion = d_insertion - unturned
        self._estimator.advance(d_insertion, d_rotation)
        self._estimator.correct(tips, self._covariance, age)
        return self._rate()

    def belief(self) -> Belief | None:
        """Return what is known after the last step; see `study.Controller.belief`.

        Nothing of `LuenbergerObserver`, whose steady gain makes no use of its covariance: a study
        of the paper's law does not pay for it.
        """
        estimate = self._estimate
        if estimate is None or isinstance(self._estimator, LuenbergerObserver):
            return None
        uncertainty, doubtful = hypotheses_of(estimate).uncertainty, estimate.doubtful
        if doubtful is not None:
            # The last word counts, as of a node that is done.
            doubtful = doubtful | ends_elsewhere(self._distance(estimate))
        return Belief(
            x=estimate.linearized[..., 0],
            x_std=np.sqrt(np.maximum(uncertainty[..., 0], 0.0)),
            sin_pitch=estimate.linearized[..., 1],
            sin_pitch_std=np.sqrt(np.maximum(uncertainty[..., 2], 0.0)),
            doubtful=doubtful,
        )

    def _distance(self, estimate: Estimate) -> FloatArray:
        """Return how far each needle is from where it is to end, (N,) [m]."""
        return np.asarray(estimate.linearized[..., 0])

    def _rate(self) -> FloatArray:
        self._estimate = self._estimator.estimate()
        return self._law(self._estimate, float(np.max(self._insertion))).rotation_rate


class NeedlesToPoints(SteeredNeedles):
    """An estimator, and a law for points: what `point_study.PointController` describes.

    Parameters
    ----------
    estimator, covariance :
        See `SteeredNeedles`.
    new_law : callable
        Returns the law for targets whose motion is told to a `TargetMotion`: it takes an estimate,
        each needle's time [s], its inserted length [m] and what its base may still turn [rad].
    rotation_budget : float
        Most that each base may turn [rad].
    """

    def __init__(
        self,
        estimator: Estimator,
        new_law: Callable[[TargetMotion], TimedLaw],
        covariance: Array | None = None,
        rotation_budget: float = math.inf,
    ) -> None:
        self._motion = TargetMotion()
        self._point_law = new_law(self._motion)
        self._rotation_budget = rotation_budget
        self._left: FloatArray = np.full((), np.nan)
        super().__init__(estimator, self._command, covariance)

    def see_targets(self, time: float, targets: FloatArray) -> None:
        """Take where the targets are; see `point_study.PointController`."""
        self._motion.see(time, targets)

    def insertion_left(self) -> FloatArray:
        """Return how far each needle has to go; see `point_study.PointController`."""
        return self._left

    def _distance(self, estimate: Estimate) -> FloatArray:
        return np.asarray(np.linalg.norm(estimate.position - self._motion.last, axis=-1))

    def _command(self, estimate: Estimate, _: float) -> SteeringCommand:
        command = self._point_law(
            estimate,
            self._insertion / INSERTION_SPEED,
            self._insertion,
            self._rotation_budget - self._turned,
        )
        assert command.insertion_left is not None
        self._left = command.insertion_left
        return command


def sliding_law(motion: TargetMotion, largest_rate: float) -> TimedLaw:
    """Return the published reference law, which goes to where the targets are; see `sliding_mode`.

    Parameters
    ----------
    motion : TargetMotion
        Of the targets.
    largest_rate : float
        Rotation per inserted length [rad/m].
    """

    def command(estimate: Estimate, *_: FloatArray) -> SteeringCommand:
        target = _in_frames_of_tips(motion.last, estimate)
        rate = sliding_mode_rate(target, largest_rate)
        return SteeringCommand(np.zeros_like(rate), rate, target[..., 2])

    return command


def rrt_law(
    motion: TargetMotion, settings: SteeringSettings, obstacles: Array | None = None
) -> TimedLaw:
    """Return the published planner as a law that plans anew at every step; see `rrt_replanning`.

    Parameters
    ----------
    motion : TargetMotion
        Of the targets.
    settings : SteeringSettings
        Of the needles.
    obstacles : ndarray, shape (M, 7), optional
        Ends of the axis and radius of each capsule [m]; none by default.
    """
    around = np.zeros((0, 7)) if obstacles is None else obstacles
    rng = np.random.default_rng(1)
    cycle = DutyCycle(settings.max_rotation_per_length, settings.step_length)

    def command(estimate: Estimate, *_: FloatArray) -> SteeringCommand:
        ahead = _in_frames_of_tips(motion.last, estimate)
        places = np.ascontiguousarray(estimate.position.reshape(-1, 3))
        turns = np.ascontiguousarray(estimate.rotation.reshape(-1, 3, 3))
        targets = np.array(np.broadcast_to(motion.last, estimate.position.shape)).reshape(-1, 3)
        # Where no path is found, the tightest arc towards the target.
        arcs = np.array(ahead.reshape(-1, 3))
        arcs[:, 2] = 1.0
        for n in range(len(arcs)):
            chance = rng.random((SAMPLES, 4))
            plan(
                places[n], turns[n], targets[n], around, settings.curvature, CLEAR, chance, arcs[n]
            )
        rate = cycle.rates(arcs).reshape(ahead.shape[:-1])
        return SteeringCommand(np.zeros_like(rate), rate, ahead[..., 2])

    return command


def planned_law(motion: TargetMotion, settings: SteeringSettings) -> TimedLaw:
    """Return the law that leads each needle along a planner's way; no obstacle is in it.

    Parameters
    ----------
    motion : TargetMotion
        Of the targets.
    settings : SteeringSettings
        Of the needles, and which planner.
    """
    law, free, plane = prompt_point_law(settings), Obstacles(), offset_plane(0.0)
    needles: list[PathSteering] = []

    def command(
        estimate: Estimate, _: FloatArray, insertion: FloatArray, __: FloatArray
    ) -> SteeringCommand:
        count = len(estimate.position)
        needles.extend(PathSteering(settings) for _ in range(count - len(needles)))
        targets = np.broadcast_to(motion.last, (count, 3))
        inserted = np.broadcast_to(insertion, (count,))
        # Who sees no way stays where it is.
        aims, longer = np.array(targets), np.zeros(count)
        for n, tip in enumerate(tip_states(estimate, plane)):
            route = needles[n].route(tip, targets[n], free, float(inserted[n]))
            longer[n] = -math.inf if route is None else route.length or math.nan
            aims[n] = aims[n] if route is None else route.aim
        said = law(estimate, aims)
        assert said.insertion_left is not None
        left = np.where(np.isnan(longer), said.insertion_left, longer)
        return SteeringCommand(said.virtual_input, said.rotation_rate, left)

    return command


def _in_frames_of_tips(points: Array, estimate: Estimate) -> Array:
    off = (points - estimate.position)[..., None]
    return np.asarray((estimate.rotation.swapaxes(-1, -2) @ off)[..., 0])


def needles_at_a_time(name: str) -> int:
    """Return how many needles of a preset to steer at a time: so many fit into a cache."""
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
    """Return what makes the controller of some needles.

    Parameters
    ----------
    name : str
        One of `PRESETS`.
    claimed : float
        Largest error of a measured coordinate that it is told the sensor makes [m].
    flip_depths : sequence of float
        Insertions at which the bevel is flipped, mirrored, in rising order [m].
    sigma_scale : float
        Other than 1: it is not told of a bound; instead each tip comes with a covariance, whose
        standard deviations are those of uniform noise within `claimed`, divided by this.
    turn_delay : float
        As of `study.StudySettings` [m].
    own : mapping
        What other packages have in place of the preset's: settings `estimator`, `law`, `planner`
        and `seed`.
    first : int
        Number of the first needle, which keys what chance an own estimator uses.

    Raises
    ------
    UserError
        If there is no such controller, or it cannot flip.
    """
    settings, covariance = _what_is_told(name, claimed, sigma_scale, flip_depths, own)
    return lambda: SteeredNeedles(
        *make_controller(settings, np.eye(3), np.zeros(3), first=first), covariance, turn_delay
    )


def point_controller_factory(
    name: str,
    claimed: float,
    *,
    sigma_scale: float = 1.0,
    rotation_budget: float = math.inf,
    own: Mapping[str, Any] = {},
    first: int = 0,
) -> Callable[[], NeedlesToPoints]:
    """Return what makes the controller of some needles that are steered to points.

    Parameters, and what is raised, as of `controller_factory`; a preset that does not estimate the
    whole pose is refused, and the reference laws have the estimator of `best`. `rotation_budget` is
    the most that each base may turn [rad]; those laws do not heed it.
    """
    preset = "best" if name in {SLIDING_MODE, RRT} else name
    settings, covariance = _what_is_told(preset, claimed, sigma_scale, (), own)
    settings.check_steers_to_points()

    def new_law(motion: TargetMotion) -> TimedLaw:
        if name == RRT:
            return rrt_law(motion, settings)
        if name == SLIDING_MODE:
            return sliding_law(motion, settings.max_rotation_per_length)
        if settings.planner:
            return planned_law(motion, settings)
        return PointSteering(settings, motion).command

    def needles() -> NeedlesToPoints:
        estimator, _ = make_controller(settings, np.eye(3), np.zeros(3), first=first)
        return NeedlesToPoints(estimator, new_law, covariance, rotation_budget)

    return needles


def _what_is_told(
    name: str,
    claimed: float,
    sigma_scale: float,
    flip_depths: Sequence[float],
    own: Mapping[str, Any],
) -> tuple[SteeringSettings, Array | None]:
    if name not in PRESETS:
        raise UserError(f"--controller {name!r} is not available; there is {', '.join(PRESETS)}")
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
