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
    trusted_far_off,
)
from needle_sim.studies.needles import DisturbedNeedles
from needle_sim.studies.study import CHUNK, Controller, StudySettings, needle_chunks

NEAREST, FARTHEST = 0.060, 0.120
"""How far ahead of their starts the points lie [m]."""
CURVATURE_SHARE = 0.6
"""Share of the needle's curvature that the arc from the true start to the point takes at most. What
a hand can aim at is more; but over its first centimetres a needle does not know yet how it lies."""
BREATHING_RATE = 0.2
"""Of targets that breathe [Hz]."""
INSERTION_SPEED = 0.002
"""How fast the needles of a study go in, where that matters [m/s]."""


@dataclasses.dataclass(frozen=True, eq=False)
class MovingTargets:
    """Targets that drift and breathe, each in directions and with a phase of its own.

    Attributes
    ----------
    places : ndarray, shape (N, 3)
        Where they are at the begin but for the breath [m].
    drift : float
        How fast each drifts [m/s].
    breath : float
        Amplitude of their breathing, a sine of time [m].
    seed, first : int
        Key the randomness: of the study, and the first target.
    """

    places: FloatArray
    drift: float = 0.0
    breath: float = 0.0
    seed: int = 0
    first: int = 0

    def part(self, first: int, count: int) -> MovingTargets:
        """Return `count` of the targets, as they are here."""
        places = self.places[first : first + count]
        return dataclasses.replace(self, places=places, first=self.first + first)

    def at(self, time: FloatArray | float) -> FloatArray:
        """Return where they are, (N, 3) [m], at a time of each or of all [s]."""
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
    """Return a point for each needle that it can reach from where it really starts.

    Parameters
    ----------
    starts : ndarray, shape (N, 3)
        x [m], pitch, roll [rad] of each needle.
    curvature : float
        Of a needle's path [1/m].
    seed : int
        Of all randomness.

    Returns
    -------
    ndarray, shape (N, 3)
        Distance ahead uniform, the place across it uniform within what can be reached [m].
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
"""Insertion left at which a needle stays where it is [m]."""


class PointController(Controller, Protocol):
    """Controller of some needles that knows where each one's way ends.

    It is told where the targets are before its start and before each step.
    """

    def set_targets(self, time: float, targets: FloatArray) -> None:
        """Take where the targets are, (N, 3) [m], at a time [s]."""

    def insertion_left(self) -> FloatArray:
        """Return how far each needle has to go on after the last step, (N,) [m]."""


@dataclasses.dataclass(frozen=True)
class PointOutcomes:
    """Outcome of each run, from the true tips.

    Attributes
    ----------
    error : ndarray, shape (N,)
        Distance of the tip from its point at the end [m].
    rotation : ndarray, shape (N,)
        Sum of all the base turned, either way [rad].
    inside_2_sigma, inside_3_sigma, missed : ndarray, shape (N,)
        As of `figures_of_merit.Outcomes`, of the end alone.
    """

    error: FloatArray
    rotation: FloatArray
    inside_2_sigma: FloatArray
    inside_3_sigma: FloatArray
    missed: FloatArray

    @property
    def reached(self) -> BoolArray:
        """Tell whether the tip ended within 1 mm of its point."""
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
        A point for each.
    new_controller : callable
        Returns a controller for some needles.
    settings : StudySettings
        What the needles have in common; a needle that is not there at the depth stays there.
    on_progress : callable
        Told after each step how many needles were on their way.
    chunk : int
        Needles steered at a time; changes the time it takes, not the outcomes.
    first : int
        Number of the first needle: of a part of a study the place where it begins.

    Returns
    -------
    PointOutcomes
        In the order of the starts.
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
        "trusted_far_off": trusted_far_off(outcomes.error, outcomes.missed),
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
    rate = controller.start(needles.measure_first())
    inserted, rotation, error = np.zeros(count), np.zeros(count), np.full(count, np.nan)
    inside, missed = np.full((2, count), np.nan), np.full(count, np.nan)
    on_the_way = np.ones(count, dtype=bool)
    begin = 0.0
    while True:
        left = np.minimum(controller.insertion_left(), settings.depth - inserted)
        # Not "left <= ARRIVED": who does not know how far it has to go stays where it is.
        arrived = on_the_way & ~(left > ARRIVED)
        if np.any(arrived):
            said = ConsistencyTally(count)
            said.add(controller.belief(), true.x, true.pitch)
            there = targets.at(inserted / INSERTION_SPEED)
            off = np.linalg.norm(true.tips - there, axis=1)
            error[arrived], missed[arrived] = off[arrived], said.missed[arrived]
            inside[:, arrived] = said.inside[:, arrived]
            on_the_way &= ~arrived
            if not np.any(on_the_way):
                break
        # What has arrived goes on unheeded: so all needles make one step at a time.
        length = np.where(on_the_way, np.minimum(left, settings.step_length), settings.step_length)
        turned = rate * length
        inserted = inserted + length
        rotation += np.where(on_the_way, np.abs(turned), 0.0)
        end = begin + settings.step_length
        needles.insert(begin, end, length, turned)
        begin = end
        on_progress(int(np.sum(on_the_way)))
        time = end / INSERTION_SPEED
        controller.set_targets(time, targets.at(time))
        tips, age = needles.seen(inserted)
        rate = controller.step(length, turned, tips, age)
    return PointOutcomes(error, rotation, inside[0], inside[1], missed)
