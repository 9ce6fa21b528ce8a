"""A study of points: many simulated needles, each steered to a point of its own."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Protocol

import numpy as np

from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.beliefs import BAND, BeliefTally, doubted
from needle_sim.studies.disturbed_needles import DisturbedNeedles
from needle_sim.studies.figures_of_merit import (
    BoolArray,
    joined,
    mean_of_what_is_said,
    trusted_far_off,
)
from needle_sim.studies.point_targets import INSERTION_SPEED, NEAREST, MovingTargets
from needle_sim.studies.study import CHUNK, Controller, StudySettings, needle_chunks

ARRIVED = 1e-4
"""Insertion left at which a needle stays where it is [m]."""


class PointController(Controller, Protocol):
    """Controller of some needles that knows where each one's way ends.

    It is told where the targets are before its start and before each step.
    """

    def see_targets(self, time: float, targets: FloatArray) -> None:
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
    return joined(parts)


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
        "inside_2_sigma": mean_of_what_is_said(outcomes.inside_2_sigma),
        "inside_3_sigma": mean_of_what_is_said(outcomes.inside_3_sigma),
        "doubtful_at_end": mean_of_what_is_said(doubted(outcomes.missed)),
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
    controller.see_targets(0.0, targets.at(0.0))
    rate = controller.start(needles.first_seen())
    inserted, rotation, error = np.zeros(count), np.zeros(count), np.full(count, np.nan)
    inside, missed = np.full((2, count), np.nan), np.full(count, np.nan)
    on_the_way = np.ones(count, dtype=bool)
    begin = 0.0
    while True:
        left = np.minimum(controller.insertion_left(), settings.depth - inserted)
        # Not "left <= ARRIVED": who does not know how far it has to go stays where it is.
        arrived = on_the_way & ~(left > ARRIVED)
        if np.any(arrived):
            said = BeliefTally(count)
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
        controller.see_targets(time, targets.at(time))
        tips, age = needles.seen(inserted)
        rate = controller.step(length, turned, tips, age)
    return PointOutcomes(error, rotation, inside[0], inside[1], missed)
