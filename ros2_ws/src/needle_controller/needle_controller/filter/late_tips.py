"""Tips that come late without saying so: told from the first centimetres; compiled.

A filter that is not told of it goes on from where the needle was, and takes each turn of the base
for one that the tip follows late. What shows is that as much of the insertion is missing from the
first millimetres on, and no more later: a needle that slips loses more the farther it goes.
"""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import math

import numpy as np

from needle_controller.model.arrays import Array
from needle_core.compiled import compiled

FIRST, LAST = 0.004, 0.020
"""Insertion since the start between which tips are asked: beyond, a needle bends too much [m]."""
_LEAST_TIPS = 5
_SURE = 3.0
_OUTLIER = 4.0


@compiled
def untold_age(
    inserted: Array,
    ways: Array,
    too_deep: float,
    entry_std: float,
    bound: float,
    scale_spread: float,
) -> float:
    """Return how old tips are that say they are new, in insertion [m]; 0 where that is not sure.

    A straight line through what the tips do not show of the insertion: its slope is slip, and what
    it begins with is age, beside the error of the first tip.

    Parameters
    ----------
    inserted : ndarray, shape (K,)
        Since the first tip, at each one's exposure as it says [m].
    ways : ndarray, shape (K, 3)
        From the first tip to each of them [m]; NaN where there is none.
    too_deep : float
        How far the first tip was beyond where the needle is known to enter [m].
    entry_std : float
        How well that is known [m]; infinite if not at all.
    bound : float
        Largest error claimed of a coordinate [m].
    scale_spread : float
        Standard deviation of the insertion scale.
    """
    least, count = bound**2 / 3.0, 0
    at, missing = np.empty(inserted.size), np.empty(inserted.size)
    for k in range(inserted.size):
        # Noise across the way makes it longer: two coordinates of both tips.
        square = ways[k, 0] ** 2 + ways[k, 1] ** 2 + ways[k, 2] ** 2 - 4.0 * least
        if FIRST <= inserted[k] <= LAST + 1e-9 and math.isfinite(square):
            at[count] = inserted[k]
            missing[count] = inserted[k] - math.sqrt(max(square, 0.0))
            count += 1
    if count < _LEAST_TIPS:
        return 0.0
    middle_missing, off = _median(missing, count), np.empty(count)
    for k in range(count):
        off[k] = abs(missing[k] - middle_missing)
    usual = max(_OUTLIER * _median(off, count), bound)
    number, middle, mean = 0, 0.0, 0.0
    for k in range(count):
        if off[k] <= usual:
            at[number], missing[number] = at[k], missing[k]
            number += 1
            middle += at[k]
            mean += missing[k]
    middle, mean = middle / number, mean / number
    squares = products = across = 0.0
    for k in range(number):
        squares += (at[k] - middle) ** 2
        products += (at[k] - middle) * (missing[k] - mean)
        across += (missing[k] - mean) ** 2
    noise = max(across / number, least)
    # missing = age + slip inserted, the slip with the prior N(0, scale_spread^2).
    slip_variance = 0.0
    if scale_spread > 0.0:
        slip_variance = 1.0 / (squares / noise + scale_spread**-2.0)
    slip = slip_variance * products / noise
    of_entry = noise / (noise + entry_std**2)
    age = mean - slip * middle - of_entry * too_deep
    start_variance = noise * (1.0 - of_entry)
    std = math.sqrt(start_variance + noise / number + slip_variance * middle**2)
    return float(age) if age > _SURE * std else 0.0


@compiled
def _median(values: Array, count: int) -> float:
    """Return the median of the first values."""
    rank = np.empty(count)
    for k in range(count):
        place = k
        while place > 0 and rank[place - 1] > values[k]:
            rank[place] = rank[place - 1]
            place -= 1
        rank[place] = values[k]
    return float(0.5 * (rank[(count - 1) // 2] + rank[count // 2]))
