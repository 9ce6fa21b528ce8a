"""Claims of a controller about its needles, and how often they are true."""

from __future__ import annotations

import dataclasses

import numpy as np

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


class BeliefTally:
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
        if belief.missed is not None:
            self.missed = belief.missed

    @property
    def inside(self) -> FloatArray:
        """Share of x and pitch within 2 (first row) and 3 sigma, (2, N); NaN if nothing is said."""
        if not self._compared:
            return np.full_like(self._within, np.nan)
        return self._within / self._compared


def doubted(missed: FloatArray) -> FloatArray:
    """Return 1 where a miss that is stated so probable is doubt, else 0; NaN if nothing is said."""
    return np.where(np.isnan(missed), np.nan, missed > DOUBT)
