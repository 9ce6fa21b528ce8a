"""Confidence in the estimate, and in the final position of the needle."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import scipy.special
from scipy.stats import qmc

from needle_controller.filter.records import NEAR
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import X
from needle_controller.observers.estimator import Estimate

MAX_MISS_PROBABILITY = 0.05
"""Probability of missing the target by `NEAR` above which the final position is doubtful."""
_95_PERCENT = 1.959964
"""Half-width of the interval with 95 % of a normal distribution [standard deviations]."""
_NORMAL_POINTS = scipy.special.ndtri(qmc.Sobol(3, scramble=False).random(512)[1:])
"""Evenly spread points of the standard normal distribution, shape (511, 3)."""


@dataclasses.dataclass(frozen=True)
class Confidence:
    """Confidence in the estimate of one needle and, at the end, in its position.

    Attributes
    ----------
    verdict : str
        "trusted", or "doubtful: " and the reason; empty if the estimator reports no probability.
    is_doubtful : bool
        Whether the verdict is "doubtful".
    r1, low, high : float
        Distance from the plane, and the interval that contains it with 95 % probability [m].
    """

    verdict: str = ""
    is_doubtful: bool = False
    r1: float = math.nan
    low: float = math.nan
    high: float = math.nan

    @property
    def summary(self) -> str:
        """Distance, interval and verdict in one line."""
        half = 0.5 * (self.high - self.low)
        text = f"r1 = {self.r1:.5f} m +- {half:.5f} m (95 %)"
        return f"{text}, {self.verdict}" if self.verdict else text


def assess_confidence(estimate: Estimate, miss_probability: float | None = None) -> Confidence:
    """Return the confidence in an estimate, or in the needle's final position.

    Parameters
    ----------
    estimate : Estimate
        Estimate of the needle.
    miss_probability : float, optional
        At the end of steering, the probability that the tip is more than `NEAR` from plane or
        point; None before the end.
    """
    x, std = float(estimate.coordinates[X]), math.sqrt(max(float(estimate.covariance[X, X]), 0.0))
    low, high = x - _95_PERCENT * std, x + _95_PERCENT * std
    if estimate.miss is None:
        return Confidence(r1=x, low=low, high=high)
    reason = ""
    if miss_probability is None and std > NEAR:
        reason = f"the uncertainty of x exceeds {1e3 * NEAR:g} mm"
    elif miss_probability is not None and miss_probability > MAX_MISS_PROBABILITY:
        percent = 100.0 * miss_probability
        reason = f"{percent:.0f} % probability of a miss by {1e3 * NEAR:g} mm or more"
    verdict = f"doubtful: {reason}" if reason else "trusted"
    return Confidence(verdict, bool(reason), x, low, high)


def point_miss_probability(offset: Array, covariance: Array) -> Array:
    """Return the probability that a tip is more than `NEAR` from a point.

    Parameters
    ----------
    offset : ndarray, shape (..., 3)
        Vector from the point to the estimated tip [m].
    covariance : ndarray, shape (..., 3, 3)
        Covariance of the tip [m^2].
    """
    values, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(values, 0.0))[..., np.newaxis, :]
    samples = offset[..., np.newaxis, :] + _NORMAL_POINTS @ np.swapaxes(root, -1, -2)
    return np.asarray(np.mean(np.sum(samples**2, axis=-1) > NEAR**2, axis=-1))
