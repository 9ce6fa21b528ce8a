"""Trust in an estimate, and in where a needle ended."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from needle_controller.model.kinematics import X
from needle_controller.observers.estimator import Estimate

TARGET_TOLERANCE = 1e-3
"""Distance from plane or point at which the needle counts as there, [KC09] IV-A [m]."""
_95_PERCENT = 1.959964
"""Half an interval that holds 95 % of a normal distribution [standard deviations]."""


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


def trust_of(estimate: Estimate, ended_off: float = 0.0) -> Trust:
    """Return how sure the estimate of one needle is, and whether that is where it should be.

    Parameters
    ----------
    estimate : Estimate
        Of the needle.
    ended_off : float
        Its distance from plane or point where it is to go no farther; 0 on the way [m].
    """
    x = float(estimate.coordinates[X])
    half = _95_PERCENT * float(np.sqrt(max(estimate.covariance[X, X], 0.0)))
    verdict = "" if estimate.doubtful is None else "trusted"
    doubts = list(estimate.doubts)
    if verdict and ends_elsewhere(ended_off):
        doubts.append(f"the needle ends {ended_off:.2g} m from its target")
    if doubts:
        verdict = f"doubtful: {'; '.join(doubts)}"
    return Trust(verdict, bool(doubts), x, x - half, x + half)


def ends_elsewhere(distance: float) -> bool:
    """Return whether a needle that ends so far from plane or point [m] is not there.

    However well it is known where they are: nobody must take such an end for a good one.
    """
    return abs(distance) > TARGET_TOLERANCE
