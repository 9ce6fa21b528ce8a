"""Outcome of a study: one row for each run, and the figures over all of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.beliefs import BAND, BeliefTally, doubted

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
    missed : ndarray, shape (N,)
        Probability that the controller gives at the end to |x| > 1 mm; NaN where it does not say.
    """

    x_start: FloatArray
    x_last: FloatArray
    settled: FloatArray
    rotation: FloatArray
    inside_2_sigma: FloatArray
    inside_3_sigma: FloatArray
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


def joined(parts: Sequence[_Rows]) -> _Rows:
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
        self.beliefs = BeliefTally(len(x))

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
        "inside_2_sigma": mean_of_what_is_said(outcomes.inside_2_sigma),
        "inside_3_sigma": mean_of_what_is_said(outcomes.inside_3_sigma),
        "doubtful_at_end": mean_of_what_is_said(doubted(outcomes.missed)),
        "trusted_far_off": trusted_far_off(outcomes.x_end, outcomes.missed),
    }


def mean_of_what_is_said(values: FloatArray) -> float | None:
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
    doubtful = doubted(missed)
    if np.any(np.isnan(doubtful)):
        return None
    return float(np.sum((np.abs(distance) > FAR_OFF) & (doubtful == 0.0)))
