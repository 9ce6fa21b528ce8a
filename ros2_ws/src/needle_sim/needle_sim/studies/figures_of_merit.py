"""Outcomes of a study: one row per run, and the figures over all runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from needle_sim.needle.se3 import FloatArray

BAND = 1e-3
"""Half width of what counts as in the plane [m]: the paper's +-1 mm."""
DOUBT = 0.05
"""Stated probability of a miss at which an end is called doubtful."""


@dataclasses.dataclass(frozen=True)
class Belief:
    """Place at which a controller takes each needle to be, and how sure it is.

    Attributes
    ----------
    x, x_std : ndarray, shape (N,)
        Distance from the plane, and its standard deviation [m].
    sin_pitch, sin_pitch_std : ndarray, shape (N,)
        Sine of the pitch out of the plane, and its standard deviation.
    missed : ndarray, shape (N,), optional
        Probability that it is more than `BAND` from plane or point; None if it never says so.
    """

    x: FloatArray
    x_std: FloatArray
    sin_pitch: FloatArray
    sin_pitch_std: FloatArray
    missed: FloatArray | None = None


class ConsistencyTally:
    """Compares what a controller says of some needles with the truth, step after step.

    Parameters
    ----------
    needles : int
        How many.

    Attributes
    ----------
    missed : ndarray, shape (N,)
        Probability that it gave to a miss after the last step; NaN if nothing is said.
    """

    def __init__(self, needles: int) -> None:
        self._within: FloatArray = np.zeros((2, needles))
        self._x_within_3: FloatArray = np.zeros(needles)
        self._compared = 0
        self.missed: FloatArray = np.full(needles, np.nan)

    def add(self, belief: Belief | None, x: FloatArray, pitch: FloatArray) -> None:
        """Take one step.

        Parameters
        ----------
        belief : Belief, optional
            What the controller says after it; None if it says nothing.
        x, pitch : ndarray, shape (N,)
            The truth [m, rad].
        """
        if belief is None:
            return
        for off, std in (
            (np.abs(belief.x - x), belief.x_std),
            (np.abs(belief.sin_pitch - np.sin(pitch)), belief.sin_pitch_std),
        ):
            self._within += off <= np.array([[2.0], [3.0]]) * std
            self._compared += 1
        self._x_within_3 += np.abs(belief.x - x) <= 3.0 * belief.x_std
        if belief.missed is not None:
            self.missed = belief.missed

    @property
    def inside(self) -> FloatArray:
        """Share of x and pitch within 2 (first row) and 3 sigma, (2, N); NaN if nothing is said."""
        if not self._compared:
            return np.full_like(self._within, np.nan)
        return self._within / self._compared

    @property
    def x_inside(self) -> FloatArray:
        """Share of x alone within 3 sigma, (N,); NaN if nothing is said."""
        if not self._compared:
            return np.full_like(self._x_within_3, np.nan)
        return 2.0 * self._x_within_3 / self._compared


def is_doubtful(missed: FloatArray) -> FloatArray:
    """Return 1 where a miss that is stated so probable is doubt, else 0; NaN if nothing is said."""
    return np.where(np.isnan(missed), np.nan, missed > DOUBT)


FAR_OFF = 5e-3
"""Distance from plane or point at which an end must not be trusted [m]."""
LAST_STEPS = 20
"""Steps at the end over which a run is judged."""

BoolArray = NDArray[np.bool_]
_Rows = TypeVar("_Rows")


@dataclasses.dataclass(frozen=True)
class Outcomes:
    """Outcome of each run, from the true tips.

    Attributes
    ----------
    x_start, x_end : ndarray, shape (N,)
        Distance from the plane at insertion 0 and at the end [m].
    x_last : ndarray, shape (N, K)
        Distance from the plane after each of the last K = `LAST_STEPS` steps [m].
    settled : ndarray, shape (N,)
        Insertion at which the tip entered the band for the last time [m]; infinite if it ended
        outside.
    rotation : ndarray, shape (N,)
        Sum of all the base turned, either way [rad].
    inside_2_sigma, inside_3_sigma : ndarray, shape (N,)
        Share of x and pitch after the last steps that lay within so many of the controller's own
        standard deviations from where it took them to be; NaN where it does not say.
    x_inside_3_sigma : ndarray, shape (N,)
        The same of x alone.
    missed : ndarray, shape (N,)
        Probability that the controller gives at the end to |x| > 1 mm; NaN where it does not say.
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
        """Tell whether |x| <= 1 mm at the end."""
        return np.asarray(np.abs(self.x_end) <= BAND)

    @property
    def converged_last_steps(self) -> BoolArray:
        """Tell whether |x| <= 1 mm after each of the last steps."""
        return np.asarray(np.all(np.abs(self.x_last) <= BAND, axis=1))

    @property
    def diverged(self) -> BoolArray:
        """Tell whether a run that missed ended farther off than it started, still moving away."""
        end = np.abs(self.x_end)
        away = (end > np.abs(self.x_start)) & (end > np.abs(self.x_last[:, 0]))
        return np.asarray(~self.converged_at_end & away)


def concatenate(parts: Sequence[_Rows]) -> _Rows:
    """Return the outcomes of all parts as one; a dataclass of arrays, one row for each run."""
    kind: Any = type(parts[0])
    names = [field.name for field in dataclasses.fields(kind)]
    whole = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return cast(_Rows, kind(**whole))


class Tally:
    """Follows some needles from start to end, in memory that does not grow with the steps.

    Parameters
    ----------
    x : ndarray, shape (N,)
        Distance from the plane at insertion 0 [m].
    steps : int
        How many steps there will be.
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
        """Tell whether the last step added is one of those over which a run is judged."""
        return self._step > self._skip

    def add(self, x: FloatArray, insertion: float, turned: FloatArray) -> None:
        """Take one step.

        Parameters
        ----------
        x : ndarray, shape (N,)
            Distance from the plane after it [m].
        insertion : float
            Inserted length after it [m].
        turned : ndarray, shape (N,)
            What the base turned in it [rad].
        """
        outside = np.abs(x) > BAND
        # infinite while outside; the insertion of the entry once inside again
        np.minimum(self._settled, insertion, out=self._settled)
        self._settled[outside] = np.inf
        self._rotation += np.abs(turned)
        if self._step >= self._skip:
            self._last[self._step - self._skip] = x
        self._step += 1

    def outcomes(self) -> Outcomes:
        """Return what became of the needles."""
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

    Settling figures are over the runs that ended inside the band, for the others never settled;
    null if there is none. What the controller says of itself is null where it says nothing.
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
        "trusted_far_off": trusted_far_off(outcomes.x_end, outcomes.missed),
    }


def mean_or_none(values: FloatArray) -> float | None:
    """Return the mean; None where nothing is said, which is NaN."""
    mean = float(np.mean(values))
    return None if np.isnan(mean) else mean


def trusted_far_off(distance: FloatArray, missed: FloatArray) -> float | None:
    """Return how many runs end beyond `FAR_OFF` and are not called doubtful; None: nothing is said.

    Parameters
    ----------
    distance : ndarray, shape (N,)
        From plane or point at the end, either side [m].
    missed : ndarray, shape (N,)
        See `Outcomes`.
    """
    doubtful = is_doubtful(missed)
    if np.any(np.isnan(doubtful)):
        return None
    return float(np.sum((np.abs(distance) > FAR_OFF) & (doubtful == 0.0)))
