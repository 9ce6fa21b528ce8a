"""Trust in an estimate of the tip, and in where a needle ended: what it says of itself."""

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

DOUBT = 0.05
"""Probability of being more than `NEAR` off at which an end is doubtful."""
_95_PERCENT = 1.959964
"""Half an interval that holds 95 % of a normal distribution [standard deviations]."""
_NORMAL_POINTS = scipy.special.ndtri(qmc.Sobol(3, scramble=False).random(512)[1:])
"""Points that a normal distribution with covariance I spreads evenly, shape (511, 3)."""


@dataclasses.dataclass(frozen=True)
class Trust:
    """Whether the estimate of one needle, and in the end the needle, is where it should be.

    Attributes
    ----------
    verdict : str
        "trusted", or "doubtful: " and why; empty where the estimator does not judge itself.
    is_doubtful : bool
        Whether it cannot.
    r1, low, high : float
        Distance from the plane, and the interval that holds it with 95 % [m].
    """

    verdict: str = ""
    is_doubtful: bool = False
    r1: float = math.nan
    low: float = math.nan
    high: float = math.nan

    @property
    def summary(self) -> str:
        """All of it in a line."""
        half = 0.5 * (self.high - self.low)
        said = f"r1 = {self.r1:.5f} m +- {half:.5f} m (95 %)"
        return f"{said}, {self.verdict}" if self.verdict else said


def trust_of(estimate: Estimate, missed: float | None = None) -> Trust:
    """Return how sure the estimate of one needle is, and whether that is where it should be.

    Parameters
    ----------
    estimate : Estimate
        Of the needle.
    missed : float, optional
        Probability that it is more than `NEAR` from plane or point where it goes no farther; None
        on the way.
    """
    x, std = float(estimate.coordinates[X]), math.sqrt(max(float(estimate.covariance[X, X]), 0.0))
    low, high = x - _95_PERCENT * std, x + _95_PERCENT * std
    if estimate.miss is None:
        return Trust(r1=x, low=low, high=high)
    doubt = ""
    if missed is None and std > NEAR:
        doubt = f"x is not known to {1e3 * NEAR:g} mm"
    elif missed is not None and missed > DOUBT:
        doubt = (
            f"{100.0 * missed:.0f} % that the tip misses its target by {1e3 * NEAR:g} mm or more"
        )
    return Trust(f"doubtful: {doubt}" if doubt else "trusted", bool(doubt), x, low, high)


def point_missed(off: Array, covariance: Array) -> Array:
    """Return the probability that a tip is more than `NEAR` from a point.

    Parameters
    ----------
    off : ndarray, shape (..., 3)
        From the point to where the tip is taken to be [m].
    covariance : ndarray, shape (..., 3, 3)
        Of the tip [m^2].
    """
    values, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(values, 0.0))[..., np.newaxis, :]
    places = off[..., np.newaxis, :] + _NORMAL_POINTS @ np.swapaxes(root, -1, -2)
    return np.asarray(np.mean(np.sum(places**2, axis=-1) > NEAR**2, axis=-1))
