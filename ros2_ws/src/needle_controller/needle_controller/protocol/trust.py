"""How sure an estimate is of the needle's distance from the plane, for a person to read."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from needle_controller.model.kinematics import X
from needle_controller.observers.estimator import Estimate

_95_PERCENT = 1.959964
"""Half an interval that holds 95 % of a normal distribution [standard deviations]."""


@dataclasses.dataclass(frozen=True)
class Trust:
    """Whether the estimate of one needle can be relied on.

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


def trust_of(estimate: Estimate) -> Trust:
    """Return how sure the estimate of one needle is."""
    x = float(estimate.coordinates[X])
    half = _95_PERCENT * float(np.sqrt(max(estimate.covariance[X, X], 0.0)))
    verdict = "" if estimate.doubtful is None else "trusted"
    if estimate.doubts:
        verdict = f"doubtful: {'; '.join(estimate.doubts)}"
    return Trust(verdict, bool(estimate.doubts), x, x - half, x + half)
