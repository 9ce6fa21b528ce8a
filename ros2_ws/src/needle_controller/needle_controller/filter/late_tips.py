"""Detection of tips that are older than their stamps, from the first centimetres; compiled.

A filter that ignores the age would continue from an old position, and would interpret each turn of
the base as a lag of the tip. With late tips, the same length of insertion is missing from the first
millimetres on; with a needle that slips, the missing length grows.
"""

from __future__ import annotations

import math

import numpy as np

from needle_controller.filter.filter_settings import SCALE_SPREAD
from needle_controller.model.arrays import Array
from needle_core.compiled import compiled

FIRST, LAST = 0.004, 0.020
"""Range of insertion in which tips are evaluated; later, a needle is too bent [m]."""
_LEAST_TIPS = 5
_SIGNIFICANCE = 3.0
_OUTLIER = 4.0


@compiled
def hidden_age(
    inserted: Array, shifts: Array, too_deep: float, entry_std: float, bound: float
) -> float:
    """Return the hidden age of tips, in insertion [m]; 0 if it is not significant.

    The age is the intercept of a straight line through the missing insertion, apart from the error
    of the first tip; the slope of the line is the slip.

    Parameters
    ----------
    inserted : ndarray, shape (K,)
        Insertion since the first tip at each stated exposure [m].
    shifts : ndarray, shape (K, 3)
        Displacement from the first tip to each tip [m]; NaN if there is none.
    too_deep : float
        Distance of the first tip beyond the known entry [m].
    entry_std : float
        Standard deviation of the entry [m]; infinite if it is not known.
    bound : float
        Largest claimed error of a coordinate [m].
    """
    least, count = bound**2 / 3.0, 0
    at, missing = np.empty(inserted.size), np.empty(inserted.size)
    for k in range(inserted.size):
        # Lateral noise, in two coordinates of both tips, makes the distance longer.
        square = shifts[k, 0] ** 2 + shifts[k, 1] ** 2 + shifts[k, 2] ** 2 - 4.0 * least
        if FIRST <= inserted[k] <= LAST + 1e-9 and math.isfinite(square):
            at[count] = inserted[k]
            missing[count] = inserted[k] - math.sqrt(max(square, 0.0))
            count += 1
    if count < _LEAST_TIPS:
        return 0.0
    middle_missing, off = _median(missing[:count]), np.empty(count)
    for k in range(count):
        off[k] = abs(missing[k] - middle_missing)
    usual = max(_OUTLIER * _median(off), bound)
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
    # missing = age + slip inserted, with the prior N(0, SCALE_SPREAD^2) of the slip.
    slip_variance = 1.0 / (squares / noise + SCALE_SPREAD**-2.0)
    slip = slip_variance * products / noise
    of_entry = noise / (noise + entry_std**2)
    age = mean - slip * middle - of_entry * too_deep
    start_variance = noise * (1.0 - of_entry)
    std = math.sqrt(start_variance + noise / number + slip_variance * middle**2)
    return float(age) if age > _SIGNIFICANCE * std else 0.0


@compiled
def _median(values: Array) -> float:
    # numpy's takes a second to compile.
    rank, count = np.empty(values.size), values.size
    for k in range(count):
        slot = k
        while slot > 0 and rank[slot - 1] > values[k]:
            rank[slot] = rank[slot - 1]
            slot -= 1
        rank[slot] = values[k]
    return float(0.5 * (rank[(count - 1) // 2] + rank[count // 2]))
