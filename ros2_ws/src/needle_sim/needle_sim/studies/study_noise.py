"""Random numbers of a study, keyed by what they are for: no chunking or order changes them."""

from __future__ import annotations

import numpy as np
import scipy.special
from numpy.typing import NDArray

from needle_sim.needle.se3 import FloatArray

START, NOISE, OUTLIER, OUTLIER_DIRECTION, MISSED, CURVATURE, BUMP, TARGET, DRIFT, BREATH = range(10)
PUSH, ROLL, BIAS = range(10, 13)
"""Purposes of random numbers."""
PER_NEEDLE = 4
"""Numbers for each needle and draw: two needles share one block of the generator."""


def uniform(seed: int, purpose: int, step: int, first: int, count: int) -> NDArray[np.float32]:
    """Return four numbers, uniform in [0, 1), for each of some needles.

    Philox counts through its sequence by a number that can be set: needle, step and purpose are
    that number.

    Parameters
    ----------
    seed : int
        Of the study, >= 0.
    purpose : int
        One of `START` ... `BIAS`.
    step : int
        Number of the exposure, or of whatever the purpose counts.
    first, count : int
        The needles `first` ... `first + count - 1`.

    Returns
    -------
    ndarray, shape (count, 4)
        A row for each needle; single precision, in steps of 2^-24.
    """
    block, skip = divmod(first, 2)
    bits = np.random.Philox(key=seed, counter=[block, step, purpose, 0])
    rows = np.random.Generator(bits).random((count + skip, PER_NEEDLE), dtype=np.float32)
    return rows[skip:]


def quantile_levels(numbers: NDArray[np.float32]) -> FloatArray:
    """Return uniform numbers as levels at which a distribution has finite quantiles.

    That is the middle of each of the 2^24 steps that a number has: 0 would be infinitely far off.
    """
    return np.asarray(numbers.astype(np.float64) + 0.5**25)


def normal(numbers: NDArray[np.float32]) -> FloatArray:
    """Return normal numbers of variance 1 from as many uniform ones."""
    return np.asarray(scipy.special.ndtri(quantile_levels(numbers)))


def directions(numbers: NDArray[np.float32]) -> FloatArray:
    """Return unit vectors, uniform on the sphere, from the first two of some uniform numbers."""
    share = numbers.astype(np.float64)
    up = 2.0 * share[:, 0] - 1.0
    across = np.sqrt(1.0 - up * up)
    around = 2.0 * np.pi * share[:, 1]
    return np.stack([across * np.cos(around), across * np.sin(around), up], axis=-1)
