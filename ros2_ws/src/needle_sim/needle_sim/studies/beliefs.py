"""Claims of a controller about its needles, and how often they are true."""

from __future__ import annotations

import dataclasses

import numpy as np
import scipy.special
from numpy.typing import NDArray

from needle_sim.needle.se3 import FloatArray

BAND = 1e-3
"""Half width of what counts as in the plane [m]: the paper's +-1 mm."""


@dataclasses.dataclass(frozen=True)
class Belief:
    """Place at which a controller takes each needle to be, and how sure it is.

    Attributes
    ----------
    x, x_std : ndarray, shape (N,)
        Distance from the plane, and its standard deviation [m].
    sin_pitch, sin_pitch_std : ndarray, shape (N,)
        Sine of the pitch out of the plane, and its standard deviation.
    doubtful : ndarray of bool, shape (N,), optional
        Whether it says that it cannot be relied on; None if it never says so.
    miss_probability : ndarray, shape (N,), optional
        Probability by its own account that the tip is more than 1 mm from the plane; None where
        that follows from `x` and `x_std`, as of a normal distribution.
    """

    x: FloatArray
    x_std: FloatArray
    sin_pitch: FloatArray
    sin_pitch_std: FloatArray
    doubtful: NDArray[np.bool_] | None = None
    miss_probability: FloatArray | None = None

    def stated_misses(self) -> FloatArray:
        """Return the probability of each tip to be more than `BAND` from the plane, (N,)."""
        if self.miss_probability is not None:
            return self.miss_probability
        sigma = np.maximum(self.x_std, 1e-9)
        above, below = (self.x - BAND) / sigma, (-BAND - self.x) / sigma
        return np.asarray(scipy.special.ndtr(above) + scipy.special.ndtr(below))


class BeliefTally:
    """Compares what a controller says of some needles with the truth, step after step.

    Parameters
    ----------
    needles : int
        How many.
    """

    def __init__(self, needles: int) -> None:
        self._within: FloatArray = np.zeros((2, needles))
        self._compared = 0
        self._doubtful: FloatArray = np.full(needles, np.nan)
        self._stated_misses: FloatArray = np.full(needles, np.nan)

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
        self._stated_misses = belief.stated_misses()
        if belief.doubtful is not None:
            self._doubtful = belief.doubtful.astype(np.float64)

    @property
    def inside(self) -> FloatArray:
        """Share of x and pitch within 2 (first row) and 3 sigma, (2, N); NaN if nothing is said."""
        if not self._compared:
            return np.full_like(self._within, np.nan)
        return self._within / self._compared

    @property
    def doubtful(self) -> FloatArray:
        """1 where the last step was called doubtful, else 0, shape (N,); NaN if nothing is said."""
        return self._doubtful

    @property
    def stated_misses(self) -> FloatArray:
        """Probability of a miss stated after the last step, shape (N,); NaN if nothing is said."""
        return self._stated_misses
