"""Study of points: many simulated needles, each steered to its own, possibly moving point."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Protocol

import numpy as np

from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.disturbances import (
    BREATH,
    DRIFT,
    TARGET,
    random_directions,
    uniform_numbers,
)
from needle_sim.studies.figures_of_merit import (
    BAND,
    BoolArray,
    ConsistencyTally,
    concatenate,
    is_doubtful,
    mean_or_none,
    undoubted_misses,
)
from needle_sim.studies.needles import DisturbedNeedles
from needle_sim.studies.study import CHUNK, Controller, StudySettings, needle_chunks

NEAREST, FARTHEST = 0.060, 0.120
"""Bounds on the distance of the points ahead of the starts [m]."""
CURVATURE_SHARE = 0.6
"""Maximum curvature of the arc from the true start to a point, as a share of the
needle's. The margin is needed because the roll is unknown over the first centimetres."""
BREATHING_RATE = 0.2
"""Breathing rate of moving targets [Hz]."""
INSERTION_SPEED = 0.002
"""Insertion speed of the needles, which sets the time for moving targets [m/s]."""


@dataclasses.dataclass(frozen=True, eq=False)
class MovingTargets:
    """Targets that drift and breathe, each with its own directions and phase.

    Attributes
    ----------
    places : ndarray, shape (N, 3)
        Mean positions at the start [m].
    drift : float
        Drift speed [m/s].
    breath : float
        Amplitude of the breathing, a sine of time [m].
    seed, first : int
        Keys of the random numbers: seed of the study, first target.
    """

    places: FloatArray
    drift: float = 0.0
    breath: float = 0.0
    seed: int = 0
    first: int = 0

    def part(self, first: int, count: int) -> MovingTargets:
        """Return `count` of the targets, with the same motion."""
        places = self.places[first : first + count]
        return dataclasses.replace(self, places=places, first=self.first + first)

    def at(self, time: FloatArray | float) -> FloatArray:
        """Return the positions, (N, 3) [m], at one time, or at a time for each target [s]."""
        count = len(self.places)
        passed = np.broadcast_to(np.asarray(time, dtype=float), (count,))[:, None]
        drifts, breaths = (
            uniform_numbers(self.seed, purpose, 0, self.first, count) for purpose in (DRIFT, BREATH)
        )
        drift, breath = random_directions(drifts), random_directions(breaths)
        phase = breaths[:, 2:3].astype(np.float64)
        swing = np.sin(2.0 * np.pi * (BREATHING_RATE * passed + phase))
        return np.asarray(self.places + self.drift * passed * drift + self.breath * swing * breath)


def random_targets(starts: FloatArray, curvature: float, seed: int) -> FloatArray:
    """Return a point for each needle that is reachable from its true start.

    Parameters
    ----------
    starts : ndarray, shape (N, 3)
        x [m], pitch, roll [rad] of each needle.
    curvature : float
        Curvature of a needle's path [1/m].
    seed : int
        Seed of the random numbers.

    Returns
    -------
    ndarray, shape (N, 3)
        Points with uniform distance ahead, uniform within the reachable cross-section [m].
    """
    count = len(starts)
    share = uniform_numbers(seed, TARGET, 0, 0, count).astype(np.float64)
    ahead = NEAREST + (FARTHEST - NEAREST) * share[:, 0]
    tightest = CURVATURE_SHARE * curvature
    # On an arc of that curvature: ahead^2 = across (2 / tightest - across).
    widest = (1.0 - np.sqrt(1.0 - (tightest * ahead) ** 2)) / tightest
    across, around = widest * np.sqrt(share[:, 1]), 2.0 * np.pi * share[:, 2]
    up, aside = across * np.cos(around), across * np.sin(around)
    x, pitch, _ = starts.T
    cosine, sine = np.cos(pitch), np.sin(pitch)
    return np.stack([x + cosine * up + sine * ahead, aside, cosine * ahead - sine * up], axis=-1)


ARRIVED = 1e-4
"""Remaining insertion below which a needle has arrived [m]."""


class PointController(Controller, Protocol):
    """Controller of some needles that computes the remaining insertion of each.

    It receives the targets before its start and before each step.
    """

    def set_targets(self, time: float, targets: FloatArray) -> None:
        """Set the positions of the targets, (N, 3) [m], at a time [s]."""

    def insertion_left(self) -> FloatArray:
        """Return the remaining insertion of each needle after the last step, (N,) [m]."""


@dataclasses.dataclass(frozen=True)
class PointOutcomes:
    """Outcomes of all runs, from the true tips.

    Attributes
    ----------
    error : ndarray, shape (N,)
        Distance of the tip from its point at the end [m].
    rotation : ndarray, shape (N,)
        Total rotation of the base, in either direction [rad].
    inside_2_sigma, inside_3_sigma, missed : ndarray, shape (N,)
        As in `figures_of_merit.Outcomes`, at the end only.
    """

    error: FloatArray
    rotation: FloatArray
    inside_2_sigma: FloatArray
    inside_3_sigma: FloatArray
    missed: FloatArray

    @property
    def reached(self) -> BoolArray:
        """Whether the tip ended within 1 mm of its point."""
        return np.asarray(self.error <= BAND)


def run_point_study(
    starts: FloatArray,
    targets: MovingTargets,
    new_controller: Callable[[], PointController],
    settings: StudySettings,
    *,
    on_progress: Callable[[int], None] = lambda _: None,
    chunk: int = CHUNK,
    first: int = 0,
) -> PointOutcomes:
    """Steer each needle from its start to its point.

    Parameters
    ----------
    starts : ndarray, shape (N, 3)
        x [m], pitch, roll [rad] of each needle.
    targets : MovingTargets
        One point per needle.
    new_controller : callable
        Returns a controller for some needles.
    settings : StudySettings
        Common settings of the needles; a needle stops at the depth even if it has not arrived.
    on_progress : callable
        Called after each step with the number of moving needles.
    chunk : int
        Number of needles steered together; it changes the run time, not the outcomes.
    first : int
        Number of the first needle, for a part of a larger study.

    Returns
    -------
    PointOutcomes
        Outcomes in the order of the starts.
    """
    parts = []
    chunks = needle_chunks(starts, settings, bump_at=0.5 * NEAREST, chunk=chunk, begin=first)
    for place, needles in chunks:
        some = targets.part(place, len(needles.true.x))
        parts.append(_steer(needles, some, new_controller(), settings, on_progress))
    return concatenate(parts)


def point_figures(outcomes: PointOutcomes) -> dict[str, float | None]:
    """Return the figures of a study of points, by the names of `monte_carlo --json`."""
    error = outcomes.error * 1e3
    return {
        "within_1_mm_point": float(np.mean(outcomes.reached)),
        "rms_point_mm": float(np.sqrt(np.mean(error**2))),
        "p95_point_mm": float(np.percentile(error, 95.0)),
        "max_point_mm": float(np.max(error)),
        "rotation_mean_deg": float(np.rad2deg(np.mean(outcomes.rotation))),
        "rotation_p95_deg": float(np.rad2deg(np.percentile(outcomes.rotation, 95.0))),
        "inside_2_sigma": mean_or_none(outcomes.inside_2_sigma),
        "inside_3_sigma": mean_or_none(outcomes.inside_3_sigma),
        "doubtful_at_end": mean_or_none(is_doubtful(outcomes.missed)),
        "trusted_far_off": undoubted_misses(outcomes.error, outcomes.missed),
    }


def _steer(
    needles: DisturbedNeedles,
    targets: MovingTargets,
    controller: PointController,
    settings: StudySettings,
    on_progress: Callable[[int], None],
) -> PointOutcomes:
    count, true = len(targets.places), needles.true
    controller.set_targets(0.0, targets.at(0.0))
    rate = controller.start(needles.measured())
    inserted, rotation, error = np.zeros(count), np.zeros(count), np.full(count, np.nan)
    inside, missed = np.full((2, count), np.nan), np.full(count, np.nan)
    is_moving = np.ones(count, dtype=bool)
    begin = 0.0
    while True:
        left = np.minimum(controller.insertion_left(), settings.depth - inserted)
        # Not "left <= ARRIVED": a needle with NaN left must stop.
        arrived = is_moving & ~(left > ARRIVED)
        if np.any(arrived):
            tally = ConsistencyTally(count)
            tally.add(controller.belief(), true.x, true.pitch)
            points = targets.at(inserted / INSERTION_SPEED)
            off = np.linalg.norm(true.tips - points, axis=1)
            error[arrived], missed[arrived] = off[arrived], tally.missed[arrived]
            inside[:, arrived] = tally.inside[:, arrived]
            is_moving &= ~arrived
            if not np.any(is_moving):
                break
        # Arrived needles move on without being evaluated, so that all needles step together.
        length = np.where(is_moving, np.minimum(left, settings.step_length), settings.step_length)
        turned = rate * length
        inserted = inserted + length
        rotation += np.where(is_moving, np.abs(turned), 0.0)
        end = begin + settings.step_length
        needles.insert(begin, end, length, turned)
        begin = end
        on_progress(int(np.sum(is_moving)))
        time = end / INSERTION_SPEED
        controller.set_targets(time, targets.at(time))
        tips, age = needles.measure(inserted)
        rate = controller.step(length, turned, tips, age)
    return PointOutcomes(error, rotation, inside[0], inside[1], missed)
