"""Estimators for the needles of a study: any kind one by one, or `best` in compiled loops."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from needle_controller.laws.roll_law import hypotheses_of
from needle_controller.many_needles import ManyFilters, ManyObservers
from needle_controller.model.arrays import Array
from needle_controller.observers.estimator import Estimate, Estimator
from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.figures_of_merit import Belief


class Estimators(Protocol):
    """Estimators of N needles."""

    def start(self, tips: FloatArray) -> None:
        """Start at the first tips, (N, 3) [m], with all rotations 0."""

    def advance(self, lengths: FloatArray, turns: FloatArray) -> None:
        """Advance by inserted lengths [m] and base rotations [rad], (N,)."""

    def correct(self, tips: FloatArray, covariance: Array | None, ages: FloatArray) -> None:
        """Correct by tips, (N, 3) [m], given a covariance, (3, 3), and their ages, (N,) [m]."""

    def belief(self) -> Belief | None:
        """Return the estimates of all needles; None if they have no covariance."""


@runtime_checkable
class PoseEstimators(Estimators, Protocol):
    """Estimators of the whole pose."""

    def each(self) -> Sequence[Estimate]:
        """Return the estimate of each needle."""

    def tips(self) -> tuple[FloatArray, FloatArray]:
        """Return the estimated tips, (N, 3) [m], and their covariances, (N, 3, 3) [m^2]."""


class SeparateEstimators:
    """Estimators of any kind, called one by one; see `Estimators`.

    Parameters
    ----------
    new : callable
        Returns the estimator of a needle, given its number from 0.
    """

    def __init__(self, new: Callable[[int], Estimator]) -> None:
        self._new = new
        self._estimators: list[Estimator] = []
        self._known: list[Estimate] = []

    def start(self, tips: FloatArray) -> None:
        """Start at the first tips."""
        self._estimators = [self._new(n) for n in range(len(tips))]
        for estimator, tip in zip(self._estimators, tips, strict=True):
            estimator.reset(tip, np.zeros(2))
        self._estimate()

    def advance(self, lengths: FloatArray, turns: FloatArray) -> None:
        """Advance by the motion of the joints."""
        moved = zip(self._estimators, lengths.tolist(), turns.tolist(), strict=True)
        for estimator, length, turn in moved:
            estimator.advance(length, turn)

    def correct(self, tips: FloatArray, covariance: Array | None, ages: FloatArray) -> None:
        """Correct by tips."""
        for estimator, tip, age in zip(self._estimators, tips, ages.tolist(), strict=True):
            estimator.correct(tip, covariance, age)
        self._estimate()

    def _estimate(self) -> None:
        self._known = [estimator.estimate() for estimator in self._estimators]

    def each(self) -> Sequence[Estimate]:
        """Return the estimate of each needle."""
        return self._known

    def belief(self) -> Belief:
        """Return the estimates of all needles."""
        uncertainty = np.array([hypotheses_of(known).mean["uncertainty"] for known in self._known])
        s = np.array([known.linearized for known in self._known])
        missed = None
        if self._known[0].miss is not None:
            missed = np.array([known.miss for known in self._known], dtype=float)
        return _belief(s, uncertainty, missed)

    def tips(self) -> tuple[FloatArray, FloatArray]:
        """Return the estimated tips and their covariances."""
        covariances = np.array([known.covariance[:3, :3] for known in self._known])
        return np.array([known.position for known in self._known]), covariances


class BestEstimators(ManyFilters):
    """Estimators of preset `best`, in compiled loops; see `Estimators`."""

    def belief(self) -> Belief:
        """Return the estimates of all needles."""
        known = self.estimates
        return _belief(known["linearized"], known["uncertainty"], known["miss"].copy())

    def tips(self) -> tuple[FloatArray, FloatArray]:
        """Return the estimated tips and their covariances."""
        known = self.estimates
        return known["coordinates"][:, :3].copy(), known["covariance"][:, :3, :3].copy()


class PaperObservers(ManyObservers):
    """Observers of [KC09] in compiled loops; see `Estimators`."""

    def belief(self) -> None:
        """Return None, because an observer with a steady-state gain has no covariance."""


def _belief(s: FloatArray, uncertainty: FloatArray, missed: FloatArray | None) -> Belief:
    return Belief(
        x=s[:, 0].copy(),
        x_std=np.sqrt(np.maximum(uncertainty[:, 0], 0.0)),
        sin_pitch=s[:, 1].copy(),
        sin_pitch_std=np.sqrt(np.maximum(uncertainty[:, 2], 0.0)),
        missed=missed,
    )
