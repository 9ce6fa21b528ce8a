"""The controllers a study can ask for: needle_controller's own estimators and laws, unchanged.

needle_sim, whose studies these are for, does not know the controller under test.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from needle_controller.laws.flip_plan import FlipPlan
from needle_controller.laws.law import LinearizingLaw, SteeringCommand, StepLaw
from needle_controller.laws.point_law import PointLawSettings
from needle_controller.laws.roll_law import RollLawSettings, hypotheses_of
from needle_controller.many_needles import ManyFilters, ManyObservers
from needle_controller.model.arrays import Array
from needle_controller.model.target_motion import TargetMotion
from needle_controller.model.target_plane import offset_plane
from needle_controller.observers.estimator import Estimate, Estimator
from needle_controller.planning.obstacles import Obstacles
from needle_controller.presets.path_steering import PathSteering, tip_state
from needle_controller.presets.point_steering import Foresight, PointSteering, prompt_point_law
from needle_controller.presets.presets import (
    filter_settings,
    make_controller,
    make_law,
    observer_settings,
)
from needle_controller.presets.steering_settings import (
    ONE_SIDED_PRESETS,
    PRESETS,
    SteeringSettings,
)
from needle_controller.protocol.trust import ends_elsewhere
from needle_core.errors import UserError
from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.beliefs import Belief
from needle_sim.studies.figures_of_merit import BoolArray
from needle_sim.studies.point_targets import INSERTION_SPEED
from needle_sim.studies.rrt_replanning import SAMPLES, DutyCycle, plan
from needle_sim.studies.sliding_mode import sliding_mode_rate
from needle_sim.studies.study import CHUNK

TimedLaw = Callable[[Estimate, float, float, float], SteeringCommand]
"""Takes an estimate, the time [s], the insertion [m], and what the base may still turn [rad]."""

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


class Estimators(Protocol):
    """The estimators of N needles."""

    def start(self, tips: FloatArray) -> None:
        """Start at first tips, (N, 3) [m], with all bases at 0."""

    def advance(self, lengths: FloatArray, turns: FloatArray) -> None:
        """Move on by inserted lengths [m] and rotations of the bases [rad], (N,)."""

    def correct(self, tips: FloatArray, covariance: Array | None, ages: FloatArray) -> None:
        """Take tips, (N, 3), of a covariance, (3, 3), and their ages, (N,) [m]."""

    def each(self) -> Sequence[Estimate]:
        """Return what is known of each."""

    def belief(self) -> Belief:
        """Return what is known of all, and whether it is doubted."""

    def positions(self) -> FloatArray:
        """Return where the tips are, (N, 3) [m]."""


class EachEstimator:
    """Estimators of any kind, one called after the other; see `Estimators`.

    Parameters
    ----------
    new : callable
        Returns the estimator of the needle with a number, counted from 0.
    """

    def __init__(self, new: Callable[[int], Estimator]) -> None:
        self._new = new
        self._estimators: list[Estimator] = []
        self._known: list[Estimate] = []

    def start(self, tips: FloatArray) -> None:
        """Start at first tips."""
        self._estimators = [self._new(n) for n in range(len(tips))]
        for estimator, tip in zip(self._estimators, tips, strict=True):
            estimator.reset(tip, np.zeros(2))
        self._estimate()

    def advance(self, lengths: FloatArray, turns: FloatArray) -> None:
        """Move on."""
        moved = zip(self._estimators, lengths.tolist(), turns.tolist(), strict=True)
        for estimator, length, turn in moved:
            estimator.advance(length, turn)

    def correct(self, tips: FloatArray, covariance: Array | None, ages: FloatArray) -> None:
        """Take tips."""
        for estimator, tip, age in zip(self._estimators, tips, ages.tolist(), strict=True):
            estimator.correct(tip, covariance, age)
        self._estimate()

    def _estimate(self) -> None:
        self._known = [estimator.estimate() for estimator in self._estimators]

    def each(self) -> Sequence[Estimate]:
        """Return what is known of each."""
        return self._known

    def belief(self) -> Belief:
        """Return what is known of all."""
        uncertainty = np.array([hypotheses_of(known).uncertainty for known in self._known])
        s = np.array([known.linearized for known in self._known])
        doubtful = None
        if self._known[0].doubtful is not None:
            doubtful = np.array([bool(known.doubtful) for known in self._known])
        return _belief(s, uncertainty, doubtful)

    def positions(self) -> FloatArray:
        """Return where the tips are."""
        return np.array([known.position for known in self._known])


class BestEstimators(ManyFilters):
    """The estimators of preset `best`, in compiled loops; see `Estimators`."""

    def belief(self) -> Belief:
        """Return what is known of all."""
        known = self.estimates
        return _belief(known["linearized"], known["uncertainty"], known["doubts"] != 0)

    def positions(self) -> FloatArray:
        """Return where the tips are."""
        return np.array(self.estimates["coordinates"][:, :3])


def _belief(s: FloatArray, uncertainty: FloatArray, doubtful: BoolArray | None) -> Belief:
    return Belief(
        x=s[:, 0].copy(),
        x_std=np.sqrt(np.maximum(uncertainty[:, 0], 0.0)),
        sin_pitch=s[:, 1].copy(),
        sin_pitch_std=np.sqrt(np.maximum(uncertainty[:, 2], 0.0)),
        doubtful=doubtful,
    )


class SteeredNeedles:
    """Estimators and laws, called as the node calls them: what `study.Controller` describes.

    Parameters
    ----------
    new_estimators : callable
        Returns the estimators of so many needles.
    rates : callable
        Returns the rotation rates, (N,) [rad/m], for estimators at an inserted length [m].
    covariance : ndarray, shape (3, 3), optional
        What each tip's is said to be [m^2]; the estimator's own assumption if none is given.
    turn_delay : float
        See `study.StudySettings`: the joints tell.
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

    @classmethod
    def one_by_one(
        cls, new: Callable[[], Estimator], law: StepLaw, covariance: Array | None = None
    ) -> SteeredNeedles:
        """Return needles of any estimator and law, each of them called in Python.

        Parameters
        ----------
        new : callable
            Returns a needle's estimator.
        law : StepLaw
            Of all needles.
        covariance : ndarray, shape (3, 3), optional
            See above.
        """
        return cls(lambda _: EachEstimator(lambda _: new()), each_rate(lambda _: law), covariance)

    def start(self, tips: FloatArray) -> FloatArray:
        """Take the first measured tips; see `study.Controller.start`."""
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
        """Take a step and what was measured after it; see `study.Controller.step`."""
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
        """Return what is known after the last step; see `study.Controller.belief`."""
        if self._estimators is None:
            return None
        belief = self._estimators.belief()
        if belief.doubtful is None:
            return belief
        # The last word counts, as of a node that is done.
        elsewhere = np.array([ends_elsewhere(off) for off in self._distance().tolist()])
        return dataclasses.replace(belief, doubtful=belief.doubtful | elsewhere)

    def _distance(self) -> FloatArray:
        """Return how far each needle is from where it is to end, (N,) [m]."""
        assert self._estimators is not None
        return np.asarray(self._estimators.positions()[:, 0])


class NeedlesToPoints(SteeredNeedles):
    """Estimators, and laws for points: what `point_study.PointController` describes.

    Parameters
    ----------
    new_estimators, covariance :
        See `SteeredNeedles`.
    new_laws : callable
        Returns the laws for targets whose motion is told to a `TargetMotion`.
    rotation_budget : float
        Most that each base may turn [rad].
    """

    def __init__(
        self,
        new_estimators: Callable[[int], Estimators],
        new_laws: Callable[[TargetMotion], PointLaws],
        covariance: Array | None = None,
        rotation_budget: float = math.inf,
    ) -> None:
        self._motion = TargetMotion()
        self._point_laws = new_laws(self._motion)
        self._rotation_budget = rotation_budget
        self._left: FloatArray = np.full((), np.nan)
        super().__init__(new_estimators, self._command, covariance)

    def see_targets(self, time: float, targets: FloatArray) -> None:
        """Take where the targets are; see `point_study.PointController`."""
        self._motion.see(time, targets)

    def insertion_left(self) -> FloatArray:
        """Return how far each needle has to go; see `point_study.PointController`."""
        return self._left

    def _distance(self) -> FloatArray:
        assert self._estimators is not None
        off = self._estimators.positions() - self._motion.last
        return np.asarray(np.linalg.norm(off, axis=-1))

    def _command(self, estimators: Any, _: float) -> FloatArray:
        rates, self._left = self._point_laws(
            estimators, self._insertion, self._rotation_budget - self._turned
        )
        return rates


class PaperNeedles:
    """The observer and the law of [KC09], in compiled loops: what `study.Controller` describes.

    Parameters
    ----------
    settings : SteeringSettings
        Of preset `paper` or `open_loop`.
    turn_delay : float
        See `SteeredNeedles`.
    """

    def __init__(self, settings: SteeringSettings, turn_delay: float) -> None:
        self._settings, self._turn_delay = settings, turn_delay
        self._needles: ManyObservers | None = None

    def start(self, tips: FloatArray) -> FloatArray:
        """Take the first measured tips; see `study.Controller.start`."""
        gains = self._settings.gains()
        law = make_law(self._settings, gains)
        self._needles = ManyObservers(
            observer_settings(self._settings, gains).model,
            law.gains if isinstance(law, LinearizingLaw) else None,
            len(tips),
        )
        return self._needles.start(tips)

    def step(
        self,
        d_insertion: float | FloatArray,
        d_rotation: FloatArray,
        tips: FloatArray,
        age: float | FloatArray,
    ) -> FloatArray:
        """Take a step and what was measured after it; see `study.Controller.step`."""
        assert self._needles is not None
        lengths = np.array(np.broadcast_to(d_insertion, len(tips)))
        unturned = np.minimum(self._turn_delay, 0.9 * lengths)
        ages = np.array(np.broadcast_to(age, len(tips)))
        return self._needles.step(lengths, unturned, d_rotation, tips, ages)

    def belief(self) -> Belief | None:
        """Return None: the steady gain makes no use of a covariance."""
        return None


PointLaws = Callable[[Any, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""Takes estimators, inserted lengths [m] and what the bases may still turn [rad], (N,); returns
rotation rates [rad/m] and insertions left [m], (N,)."""


def each_rate(new_law: Callable[[int], StepLaw]) -> Callable[[Estimators, float], FloatArray]:
    """Return rotation rates by laws that are called in Python, one after the other."""
    laws: list[StepLaw] = []

    def rates(estimators: Estimators, insertion: float) -> FloatArray:
        known = estimators.each()
        laws.extend(new_law(n) for n in range(len(laws), len(known)))
        return np.array(
            [law(one, insertion).rotation_rate for law, one in zip(laws, known, strict=True)]
        )

    return rates


def each_point_law(motion: TargetMotion, new_law: Callable[[TargetMotion], TimedLaw]) -> PointLaws:
    """Return laws for points that are called in Python, one after the other.

    Parameters
    ----------
    motion : TargetMotion
        Of all targets.
    new_law : callable
        Returns the law of one needle, whose target's motion is told to a `TargetMotion`.
    """
    laws: list[tuple[TargetMotion, TimedLaw]] = []

    def commands(
        estimators: Estimators, insertion: FloatArray, rotation_left: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        known = estimators.each()
        for _ in range(len(laws), len(known)):
            own = TargetMotion()
            laws.append((own, new_law(own)))
        targets = np.broadcast_to(motion.last, (len(known), 3))
        rates, left = np.empty(len(known)), np.empty(len(known))
        for n, (own, law) in enumerate(laws):
            own.see(motion.seen, targets[n])
            inserted = float(insertion[n])
            said = law(known[n], inserted / INSERTION_SPEED, inserted, float(rotation_left[n]))
            assert said.insertion_left is not None
            rates[n], left[n] = said.rotation_rate, said.insertion_left
        return rates, left

    return commands


def best_rates(settings: SteeringSettings) -> Callable[[ManyFilters, float], FloatArray]:
    """Return rotation rates by the law of `best`, in compiled loops."""
    law, plan = RollLawSettings(**settings.turning), FlipPlan(settings.flip_depths)

    def rates(filters: ManyFilters, insertion: float) -> FloatArray:
        return filters.roll_rates(law, plan.bend_sign(insertion) if plan.depths else 0.0)

    return rates


def best_point_laws(settings: SteeringSettings, motion: TargetMotion) -> PointLaws:
    """Return the law of `best` for points, in compiled loops."""
    law, foresight = PointLawSettings(**settings.turning), Foresight(motion)

    def commands(
        filters: ManyFilters, insertion: FloatArray, rotation_left: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        def left(targets: FloatArray) -> FloatArray:
            return filters.point_rates(law, targets, rotation_left)[1]

        targets = foresight.look(insertion / INSERTION_SPEED, insertion, left)
        return filters.point_rates(law, targets, rotation_left)

    return commands


def sliding_law(motion: TargetMotion, largest_rate: float) -> TimedLaw:
    """Return the published reference law, which goes to where the target is; see `sliding_mode`.

    Parameters
    ----------
    motion : TargetMotion
        Of the target.
    largest_rate : float
        Rotation per inserted length [rad/m].
    """

    def command(estimate: Estimate, *_: float) -> SteeringCommand:
        target = estimate.rotation.T @ (motion.last - estimate.position)
        rate = float(sliding_mode_rate(target, largest_rate))
        return SteeringCommand(0.0, rate, float(target[2]))

    return command


def rrt_law(
    motion: TargetMotion,
    settings: SteeringSettings,
    rng: np.random.Generator,
    obstacles: Array | None = None,
) -> TimedLaw:
    """Return the published planner as a law that plans anew at every step; see `rrt_replanning`.

    Parameters
    ----------
    motion : TargetMotion
        Of the target.
    settings : SteeringSettings
        Of the needle.
    rng : numpy.random.Generator
        All chance of the planner.
    obstacles : ndarray, shape (M, 7), optional
        Ends of the axis and radius of each capsule [m]; none by default.
    """
    around = np.zeros((0, 7)) if obstacles is None else obstacles
    cycle = DutyCycle(settings.max_rotation_per_length, settings.step_length)

    def command(estimate: Estimate, *_: float) -> SteeringCommand:
        ahead = estimate.rotation.T @ (motion.last - estimate.position)
        # Where no path is found, the tightest arc towards the target.
        arc = np.array([ahead[0], ahead[1], 1.0])
        plan(
            np.array(estimate.position),
            np.ascontiguousarray(estimate.rotation),
            np.array(motion.last),
            around,
            settings.curvature,
            CLEAR,
            rng.random((SAMPLES, 4)),
            arc,
        )
        return SteeringCommand(0.0, float(cycle.rates(arc[None])[0]), float(ahead[2]))

    return command


def planned_law(motion: TargetMotion, settings: SteeringSettings) -> TimedLaw:
    """Return the law that leads a needle along a planner's way; no obstacle is in it.

    Parameters
    ----------
    motion : TargetMotion
        Of the target.
    settings : SteeringSettings
        Of the needle, and which planner.
    """
    law, free, plane = prompt_point_law(settings), Obstacles(), offset_plane(0.0)
    needle = PathSteering(settings)

    def command(estimate: Estimate, _: float, insertion: float, __: float) -> SteeringCommand:
        route = needle.route(tip_state(estimate, plane), motion.last, free, insertion)
        if route is None:
            # Who sees no way stays where it is.
            return SteeringCommand(0.0, 0.0, -math.inf)
        said = law(estimate, route.aim)
        left = said.insertion_left if route.length is None else route.length
        return SteeringCommand(said.virtual_input, said.rotation_rate, left)

    return command


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
) -> Callable[[], SteeredNeedles | PaperNeedles]:
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
    if name in ONE_SIDED_PRESETS and not settings.estimator and not settings.law:
        return lambda: PaperNeedles(settings, turn_delay)
    rates: Callable[[Any, float], FloatArray] = best_rates(settings)
    if settings.estimator or settings.law or name in ONE_SIDED_PRESETS:
        rates = each_rate(lambda _: make_controller(settings, np.eye(3))[1])
    return lambda: SteeredNeedles(new_estimators(settings, first), rates, covariance, turn_delay)


def new_estimators(settings: SteeringSettings, first: int) -> Callable[[int], Estimators]:
    """Return what makes the estimators of so many needles, the first of which has a number."""
    if settings.preset == "best" and not settings.estimator:
        known = filter_settings(settings)
        return lambda count: BestEstimators(known, count, settings.step_length)

    def new(n: int) -> Estimator:
        return make_controller(settings, np.eye(3), np.zeros(3), number=first + n)[0]

    return lambda _: EachEstimator(new)


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
