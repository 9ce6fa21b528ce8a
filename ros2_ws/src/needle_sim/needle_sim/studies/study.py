"""Study: many simulated needles, each steered by a controller from its start to the final depth."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Protocol

import numpy as np

from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.disturbances import START, Disturbances, uniform_numbers, within_one
from needle_sim.studies.figures_of_merit import Belief, Outcomes, Tally, concatenate
from needle_sim.studies.needles import DisturbedNeedles

POINTS = 10
"""Number of grid points along each coordinate."""


@dataclasses.dataclass(frozen=True)
class StartBounds:
    """Maximum |x| [m], |pitch| and |roll| [rad] of a start."""

    x: float
    pitch: float
    roll: float

    @property
    def half_widths(self) -> FloatArray:
        """The three bounds, in the order of a start."""
        return np.array([self.x, self.pitch, self.roll])


def _grid(unit: FloatArray) -> Callable[[StartBounds, int, int], FloatArray]:
    """Return the function of a 10 x 10 x 10 grid, with coordinates as shares of the bounds."""

    def starts(bounds: StartBounds, draws: int, seed: int) -> FloatArray:
        points = np.stack(np.meshgrid(unit, unit, unit, indexing="ij"), axis=-1).reshape(-1, 3)
        return np.repeat(points * bounds.half_widths, draws, axis=0)

    return starts


def random_starts(bounds: StartBounds, draws: int, seed: int) -> FloatArray:
    """Return random starts, uniform within the bounds, as many as the grids have runs."""
    numbers = uniform_numbers(seed, START, 0, 0, POINTS**3 * draws)[:, :3]
    return within_one(numbers) * bounds.half_widths


GRIDS: Mapping[str, Callable[[StartBounds, int, int], FloatArray]] = {
    # The outermost points of one grid are the bounds; the other one has cells within them.
    "endpoint": _grid(np.linspace(-1.0, 1.0, POINTS)),
    "cell": _grid((2.0 * np.arange(POINTS) + 1.0) / POINTS - 1.0),
    "random": random_starts,
}
"""Functions of bounds, draws and seed; they return x [m], pitch, roll [rad], (1000 draws, 3)."""


CHUNK = 500
"""Number of needles steered together: their state fits into a processor's cache."""


class Controller(Protocol):
    """Controller of some needles, which are the leading axis of all arrays.

    A final tip is measured after the last step, as in the node.
    """

    def start(self, tips: FloatArray) -> FloatArray:
        """Start with the first measured tips, (N, 3) [m]; return rotation rates, (N,) [rad/m]."""

    def step(
        self,
        d_insertion: float | FloatArray,
        d_rotation: FloatArray,
        tips: FloatArray,
        age: float | FloatArray,
    ) -> FloatArray:
        """Process the motion of a step and the measurement after it.

        Parameters
        ----------
        d_insertion : float, or ndarray, shape (N,)
            Insertion of the step, of all needles or of each [m].
        d_rotation : ndarray, shape (N,)
            Rotation of the bases [rad].
        tips : ndarray, shape (N, 3)
            The measured tips [m]; NaN where missing.
        age : float, or ndarray, shape (N,)
            Insertion since the measurement, of all needles or of each [m].

        Returns
        -------
        ndarray, shape (N,)
            Rotation of the base per inserted length over the next step [rad/m].
        """

    def belief(self) -> Belief | None:
        """Return the estimate after the last step; None from a controller without estimates."""


@dataclasses.dataclass(frozen=True)
class StudySettings:
    """Common settings of all needles of a study.

    Attributes
    ----------
    curvature : float
        Curvature that the controller assumes [1/m]; `disturbances` set the plant's deviation.
    depth : float
        Final insertion [m].
    step_length : float
        Insertion between measurements [m]; the last step ends at the depth.
    disturbances : Disturbances
        Disturbances of plant and measurements.
    seed : int
        Seed of all random numbers.
    turn_delay : float
        Insertion between a measurement and the start of the resulting rotation, less than a step
        [m]: for continuous insertion, the speed times the response time.
    """

    curvature: float
    depth: float
    step_length: float
    disturbances: Disturbances
    seed: int
    turn_delay: float = 0.0

    @property
    def steps(self) -> int:
        """Number of steps."""
        return max(1, math.ceil(self.depth / self.step_length - 1e-9))


def run_study(
    starts: FloatArray,
    new_controller: Callable[[], Controller],
    settings: StudySettings,
    *,
    on_progress: Callable[[int], None] = lambda _: None,
    chunk: int = CHUNK,
    first: int = 0,
) -> Outcomes:
    """Steer each needle from its start to the depth.

    Parameters
    ----------
    starts : ndarray, shape (N, 3)
        x [m], pitch, roll [rad] of each needle.
    new_controller : callable
        Returns a controller for some needles.
    settings : StudySettings
        Common settings of the needles.
    on_progress : callable
        Called after each step with the number of needles.
    chunk : int
        Number of needles steered together; it changes the run time, not the outcomes.
    first : int
        Number of the first needle, for a part of a larger study.

    Returns
    -------
    Outcomes
        Outcomes in the order of the starts.
    """
    chunks = needle_chunks(starts, settings, bump_at=0.5 * settings.depth, chunk=chunk, begin=first)
    return concatenate(
        [_steer(needles, new_controller(), settings, on_progress) for _, needles in chunks]
    )


def needle_chunks(
    starts: FloatArray, settings: StudySettings, *, bump_at: float, chunk: int, begin: int = 0
) -> Iterator[tuple[int, DisturbedNeedles]]:
    """Yield the needles of a study in chunks: (index of the first one, needles).

    `bump_at` is that of `DisturbedNeedles`, `begin` the `first` of `run_study`; the other arguments
    are those of `run_study`.
    """
    for first in range(0, len(starts), chunk):
        yield (
            first,
            DisturbedNeedles(
                starts[first : first + chunk],
                settings.disturbances,
                curvature=settings.curvature,
                bump_at=bump_at,
                seed=settings.seed,
                first=begin + first,
            ),
        )


def _steer(
    needles: DisturbedNeedles,
    controller: Controller,
    settings: StudySettings,
    on_progress: Callable[[int], None],
) -> Outcomes:
    steps, true = settings.steps, needles.true
    tally = Tally(true.x, steps)
    rate = controller.start(needles.measured())
    insertion = 0.0
    for step in range(1, steps + 1):
        reached = min(step * settings.step_length, settings.depth)
        length = reached - insertion
        turned = rate * length
        # The rotation ends with the step, whenever it starts.
        turns_from = insertion + min(settings.turn_delay, 0.9 * length)
        if turns_from > insertion:
            needles.insert(insertion, turns_from, turns_from - insertion, 0.0 * turned)
        needles.insert(turns_from, reached, reached - turns_from, turned)
        insertion = reached
        tally.add(true.x, insertion, turned)
        on_progress(len(true.x))
        tips, age = needles.measure(insertion)
        rate = controller.step(length, turned, tips, age)
        if tally.in_last_steps:
            tally.beliefs.add(controller.belief(), true.x, true.pitch)
    return tally.outcomes()
