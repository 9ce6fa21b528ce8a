"""Outcomes of a study: one row per run, and the figures over all runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from needle_sim.needle.se3 import FloatArray

BAND = 1e-3
"""Half width of the band around the plane [m]: the paper's +-1 mm."""
DOUBT = 0.05
"""Stated probability of a miss above which the end of a run counts as doubtful."""


@dataclasses.dataclass(frozen=True)
class Belief:
    """Estimate of a controller for each needle, with its uncertainty.

    Attributes
    ----------
    x, x_std : ndarray, shape (N,)
        Distance from the plane, and its standard deviation [m].
    sin_pitch, sin_pitch_std : ndarray, shape (N,)
        Sine of the pitch out of the plane, and its standard deviation.
    missed : ndarray, shape (N,), optional
        Probability that the tip is more than `BAND` from plane or point; None if not estimated.
    """

    x: FloatArray
    x_std: FloatArray
    sin_pitch: FloatArray
    sin_pitch_std: FloatArray
    missed: FloatArray | None = None


class ConsistencyTally:
    """Compares the estimates of a controller with the truth, step by step.

    Parameters
    ----------
    needles : int
        Number of needles.

    Attributes
    ----------
    missed : ndarray, shape (N,)
        Estimated probability of a miss after the last step; NaN if not estimated.
    """

    def __init__(self, needles: int) -> None:
        # Steps in which x, and the pitch, was within 2 and within 3 standard deviations.
        self._within: FloatArray = np.zeros((2, 2, needles))
        self._steps = 0
        self.missed: FloatArray = np.full(needles, np.nan)

    def add(self, belief: Belief | None, x: FloatArray, pitch: FloatArray) -> None:
        """Add one step.

        Parameters
        ----------
        belief : Belief, optional
            Estimate of the controller after the step; None if it has none.
        x, pitch : ndarray, shape (N,)
            True values [m, rad].
        """
        if belief is None:
            return
        off = np.abs([belief.x - x, belief.sin_pitch - np.sin(pitch)])
        std = np.array([belief.x_std, belief.sin_pitch_std])
        self._within += off[:, np.newaxis] <= np.array([[2.0], [3.0]]) * std[:, np.newaxis]
        self._steps += 1
        if belief.missed is not None:
            self.missed = belief.missed

    @property
    def inside(self) -> FloatArray:
        """Share of x and pitch within 2 (first row) and 3 sigma, (2, N); NaN without estimates."""
        return self._share(self._within.mean(axis=0))

    @property
    def x_inside(self) -> FloatArray:
        """Share of x alone within 3 sigma, (N,); NaN without estimates."""
        return self._share(self._within[0, 1])

    def _share(self, count: FloatArray) -> FloatArray:
        return count / self._steps if self._steps else np.full_like(count, np.nan)


def is_doubtful(missed: FloatArray) -> FloatArray:
    """Return 1 if the probability of a miss exceeds `DOUBT`, else 0; NaN without estimates."""
    return np.where(np.isnan(missed), np.nan, missed > DOUBT)


FAR_OFF = 5e-3
"""Distance from plane or point beyond which the end of a run should count as doubtful [m]."""
LAST_STEPS = 20
"""Number of final steps that are evaluated."""

BoolArray = NDArray[np.bool_]
_Rows = TypeVar("_Rows")


@dataclasses.dataclass(frozen=True)
class Outcomes:
    """Outcomes of all runs, from the true tips.

    Attributes
    ----------
    x_start, x_end : ndarray, shape (N,)
        Distance from the plane at insertion 0 and at the end [m].
    x_last : ndarray, shape (N, K)
        Distance from the plane after each of the last K = `LAST_STEPS` steps [m].
    settled : ndarray, shape (N,)
        Insertion at which the tip last entered the band [m]; infinite if it ended outside.
    rotation : ndarray, shape (N,)
        Total rotation of the base, in either direction [rad].
    inside_2_sigma, inside_3_sigma : ndarray, shape (N,)
        Share of x and pitch after the last steps within 2 or 3 of the controller's own standard
        deviations; NaN without estimates.
    x_inside_3_sigma : ndarray, shape (N,)
        The same for x alone.
    missed : ndarray, shape (N,)
        Probability of |x| > 1 mm at the end, estimated by the controller; NaN without estimates.
    """

    x_start: FloatArray
    x_last: FloatArray
    settled: FloatArray
    rotation: FloatArray
    inside_2_sigma: FloatArray
    inside_3_sigma: FloatArray
    x_inside_3_sigma: FloatArray
    missed: FloatArray

    @property
    def x_end(self) -> FloatArray:
        """Distance from the plane at the end, (N,) [m]."""
        return np.asarray(self.x_last[:, -1])

    @property
    def converged_at_end(self) -> BoolArray:
        """Whether |x| <= 1 mm at the end."""
        return np.asarray(np.abs(self.x_end) <= BAND)

    @property
    def converged_last_steps(self) -> BoolArray:
        """Whether |x| <= 1 mm after each of the last steps."""
        return np.asarray(np.all(np.abs(self.x_last) <= BAND, axis=1))

    @property
    def diverged(self) -> BoolArray:
        """Whether a run that missed ended farther from the plane than it started, moving away."""
        end = np.abs(self.x_end)
        away = (end > np.abs(self.x_start)) & (end > np.abs(self.x_last[:, 0]))
        return np.asarray(~self.converged_at_end & away)


def concatenate(parts: Sequence[_Rows]) -> _Rows:
    """Concatenate dataclasses of arrays with one row per run."""
    kind: Any = type(parts[0])
    names = [field.name for field in dataclasses.fields(kind)]
    whole = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return cast(_Rows, kind(**whole))


class Tally:
    """Accumulates the outcomes of some needles, in memory independent of the number of steps.

    Parameters
    ----------
    x : ndarray, shape (N,)
        Distance from the plane at insertion 0 [m].
    steps : int
        Number of steps.
    """

    def __init__(self, x: FloatArray, steps: int) -> None:
        self._start = np.array(x)
        self._skip = max(steps - LAST_STEPS, 0)
        self._last: FloatArray = np.empty((min(steps, LAST_STEPS), len(x)))
        self._step = 0
        self._settled: FloatArray = np.where(np.abs(x) <= BAND, 0.0, np.inf)
        self._rotation: FloatArray = np.zeros(len(x))
        self.beliefs = ConsistencyTally(len(x))

    @property
    def in_last_steps(self) -> bool:
        """Whether the last added step is one of the final steps that are evaluated."""
        return self._step > self._skip

    def add(self, x: FloatArray, insertion: float, turned: FloatArray) -> None:
        """Add one step.

        Parameters
        ----------
        x : ndarray, shape (N,)
            Distance from the plane after the step [m].
        insertion : float
            Inserted length after the step [m].
        turned : ndarray, shape (N,)
            Rotation of the base in the step [rad].
        """
        outside = np.abs(x) > BAND
        # Infinite while outside; the insertion of the entry once inside.
        np.minimum(self._settled, insertion, out=self._settled)
        self._settled[outside] = np.inf
        self._rotation += np.abs(turned)
        if self._step >= self._skip:
            self._last[self._step - self._skip] = x
        self._step += 1

    def outcomes(self) -> Outcomes:
        """Return the outcomes."""
        inside_2_sigma, inside_3_sigma = self.beliefs.inside
        return Outcomes(
            x_start=self._start,
            x_last=self._last.T.copy(),
            settled=self._settled,
            rotation=self._rotation,
            inside_2_sigma=inside_2_sigma,
            inside_3_sigma=inside_3_sigma,
            x_inside_3_sigma=self.beliefs.x_inside,
            missed=self.beliefs.missed,
        )


def figures(outcomes: Outcomes) -> dict[str, float | None]:
    """Return the figures of a study, by the names of `monte_carlo --json`.

    Settling figures cover the runs that ended inside the band; they are null without such runs.
    Figures of the controller's estimates are null without estimates.
    """
    at_end = outcomes.converged_at_end
    last = np.abs(outcomes.x_last) * 1e3
    end = np.abs(outcomes.x_end) * 1e3
    settled = outcomes.settled[at_end] * 1e3
    return {
        "converged_at_end": float(np.mean(at_end)),
        "converged_last_20": float(np.mean(outcomes.converged_last_steps)),
        "rms_last_20_mm": float(np.sqrt(np.mean(last**2))),
        "p95_last_20_mm": float(np.percentile(last, 95.0)),
        "max_last_20_mm": float(np.max(last)),
        "settle_median_mm": float(np.median(settled)) if settled.size else None,
        "settle_p95_mm": float(np.percentile(settled, 95.0)) if settled.size else None,
        "rotation_mean_deg": float(np.rad2deg(np.mean(outcomes.rotation))),
        "final_p95_mm": float(np.percentile(end, 95.0)),
        "final_max_mm": float(np.max(end)),
        "missed_runs": float(np.sum(~at_end)),
        "diverged": float(np.mean(outcomes.diverged)),
        "inside_2_sigma": mean_or_none(outcomes.inside_2_sigma),
        "inside_3_sigma": mean_or_none(outcomes.inside_3_sigma),
        "x_inside_3_sigma": mean_or_none(outcomes.x_inside_3_sigma),
        "doubtful_at_end": mean_or_none(is_doubtful(outcomes.missed)),
        "trusted_far_off": undoubted_misses(outcomes.x_end, outcomes.missed),
    }


def mean_or_none(values: FloatArray) -> float | None:
    """Return the mean; None if a value is NaN."""
    mean = float(np.mean(values))
    return None if np.isnan(mean) else mean


def undoubted_misses(distance: FloatArray, missed: FloatArray) -> float | None:
    """Return the number of undoubted runs that end beyond `FAR_OFF`; None without estimates.

    Parameters
    ----------
    distance : ndarray, shape (N,)
        Distance from plane or point at the end, of either sign [m].
    missed : ndarray, shape (N,)
        See `Outcomes`.
    """
    doubtful = is_doubtful(missed)
    if np.any(np.isnan(doubtful)):
        return None
    return float(np.sum((np.abs(distance) > FAR_OFF) & (doubtful == 0.0)))
