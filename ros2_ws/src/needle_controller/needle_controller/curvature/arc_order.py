"""Whether tips miss their arc at random, or in order along it: then it is not the needle's path."""

from __future__ import annotations

import math

import numpy as np

from needle_controller.model.arrays import Array
from needle_core.errors import UserError

_CLIPPED = 3.0  # outliers count as if they were so many standard deviations off
_NEIGHBOURS = 8  # within this share of all tips, two are neighbours
_BY_CHANCE = 3.0  # standard deviations of what independent errors show
_ALLOWED = 5e-5  # what a tracker's errors have in common from one tip to the next [m]
_REPEATING = 2.5  # and in repeating errors
_MEDIAN = math.sqrt(2.0 * math.log(2.0))  # of the length of a vector of two normal components


def order(misses: Array) -> tuple[float, float]:
    """Return how much of its miss each tip shares with its neighbours.

    Parameters
    ----------
    misses : ndarray, shape (K, 3)
        What each tip is off its arc, across it [m], in order.

    Returns
    -------
    shared : float
        Root mean square of what is shared [m]; 0 where nothing is.
    significance : float
        In standard deviations of what independent errors give [-].
    """
    lengths = np.linalg.norm(misses, axis=-1)
    sigma = float(np.median(lengths)) / _MEDIAN
    clipped = misses * np.minimum(1.0, _CLIPPED * sigma / np.maximum(lengths, 1e-12))[:, None]
    squared = np.sum(clipped**2, axis=-1)
    total, variance, pairs = 0.0, 0.0, 0
    for apart in range(1, len(misses) // _NEIGHBOURS + 1):
        total += float(np.sum(clipped[apart:] * clipped[:-apart]))
        # Two independent directions across: their cosine is 1/2 in the square, on average.
        variance += 0.5 * float(squared[apart:] @ squared[:-apart])
        pairs += len(misses) - apart
    significance = total / math.sqrt(variance) if variance > 0.0 else 0.0
    return math.sqrt(max(total, 0.0) / max(pairs, 1)), significance


def check_order(misses: Array, repeating_error: float) -> None:
    """Check that tips miss their arc at random.

    Parameters
    ----------
    misses : ndarray, shape (K, 3)
        What each tip is off its arc, across it [m], in order.
    repeating_error : float
        What all tips may be off together [m].

    Raises
    ------
    UserError
        They do not: says by how much.
    """
    shared, significance = order(misses)
    allowed = max(_ALLOWED, _REPEATING * repeating_error)
    if shared > allowed and significance > _BY_CHANCE:
        raise UserError(
            f"the tips follow no single arc: one after the other they are {1e3 * shared:.2f} mm "
            f"beside it, wants <= {1e3 * allowed:.2f} mm; the base was turned on the way, or the "
            "tissue changes (--until-mm takes what is before; a column rotation_rad tells which)"
        )
