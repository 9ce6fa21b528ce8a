"""A needle's two edges in a few rows of a fine strip, whatever lies beside or on it.

A needle's edges are steep and as far apart as it is wide. What it throws on the floor has soft
edges; a glint on the shaft rises where an edge falls. So the edges still tell where the middle is
when a shadow along the needle, or a bubble beside it, draws the centroid of what is dark to one
side. Of two edges the steeper counts for more: one that borders on a shadow hardly stands out.
Edges farther apart than the needle is wide are those of the needle and something else together.
"""

# Compiled functions take plain numbers, one by one.
# ruff: noqa: PLR0917

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled
from needle_tracker.image.strip import STEP_PX

Array = NDArray[np.float64]

_EITHER_WAY = 3  # rows that are looked at together
_SLOPE_COLUMNS = 2  # either way
_SEARCH_PX = 4.0  # the middle is looked for so far beside the strip's
_FAR_FROM_MIDDLE = 0.01  # what each column costs
# Steepness over the needle's contrast: of both edges together, of one that counts, of a full one.
_BOTH, _ONE, _FULL = 0.6, 0.2, 1.0
_LOOK_COLUMNS = 2  # an edge is so near where the needle's width has it
_PEAK_COLUMNS, _PEAK_SHARE = 6, 0.4
# What lies beside an edge, so far and so wide [columns], is something if it is so dark, or bright.
_BESIDE_FROM, _BESIDE_COLUMNS, _LEAST_CONTRAST_BESIDE = 1.6, 4, 0.15
# Width of a bell at half its height, over how far it takes from three quarters to one quarter.
_BELL = 2.6


@compiled
def edges_middle(
    darkness: Array, row: int, last: int, width: float, contrast: float, level: Array, steep: Array
) -> float:
    """Return the middle between a needle's edges about one row [px from the strip's middle].

    Parameters
    ----------
    darkness : ndarray, shape (rows, columns)
        From `fine_strip`.
    row, last : int
        Which row, and the last one that shows the needle.
    width : float
        Of the needle [px].
    contrast : float
        Of the needle [grey levels].
    level, steep : ndarray, shape (columns,)
        Are written over.

    Returns
    -------
    float
        NaN where there are no such edges.
    """
    columns = darkness.shape[1]
    reach = columns // 2
    steepness(
        darkness, max(row - _EITHER_WAY, 0), min(row + _EITHER_WAY, last), contrast, level, steep
    )
    half = 0.5 * width / STEP_PX
    search = int(_SEARCH_PX / STEP_PX)
    largest, middle = _BOTH, -1
    for j in range(reach - search, reach + search + 1):
        score = -_FAR_FROM_MIDDLE * abs(j - reach)
        for side in (-1, 1):
            score += min(max(-side * between(steep, j + side * half), 0.0), _FULL)
        if score > largest:
            largest, middle = score, j
    if middle < 0:
        return np.nan
    total = moment = 0.0
    for side in (-1, 1):
        expected = round(middle + side * half)
        first, final = max(expected - _LOOK_COLUMNS, 1), min(expected + _LOOK_COLUMNS, columns - 2)
        edge = first
        for j in range(first, final + 1):
            if -side * steep[j] > -side * steep[edge]:
                edge = j
        # At the border of what is looked at it goes on beyond: somebody else's edge.
        if -side * steep[edge] < _ONE or edge in (first, final):
            continue
        weight = steep[edge] ** 4
        total += weight
        moment += weight * (peak_place(steep, edge) - side * half - reach)
    if not total > 0.0:
        return np.nan
    place = reach + moment / total
    if not (is_something(level, place, half, -1) or is_something(level, place, half, 1)):
        return np.nan
    return float(STEP_PX * (place - reach))


@compiled
def is_something(level: Array, place: float, half: float, side: int) -> bool:
    """Return whether something lies beside the needle.

    Else its edges are as steep as its own shading has them, and say nothing.
    """
    beside = 0.0
    for k in range(_BESIDE_COLUMNS):
        column = place + side * (half + _BESIDE_FROM + k)
        beside += abs(between(level, column)) / _BESIDE_COLUMNS
    return beside > _LEAST_CONTRAST_BESIDE


@compiled
def steepness(
    darkness: Array, first: int, last: int, contrast: float, level: Array, steep: Array
) -> None:
    """Write how steeply rows first to last, together, get darker to the right [contrasts]."""
    columns = darkness.shape[1]
    scale = 1.0 / ((last - first + 1) * contrast)
    level[:] = 0.0
    for i in range(first, last + 1):
        for j in range(columns):
            level[j] += scale * darkness[i, j]
    for j in range(columns):
        left, right = max(j - _SLOPE_COLUMNS, 0), min(j + _SLOPE_COLUMNS, columns - 1)
        steep[j] = level[right] - level[left]


@compiled
def between(values: Array, place: float) -> float:
    """Return a value between two columns."""
    k = min(max(math.floor(place), 0), len(values) - 2)
    return float(values[k] + (place - k) * (values[k + 1] - values[k]))


@compiled
def peak_place(values: Array, top: int) -> float:
    """Return where a peak, up or down, is: the centroid of what is nearly as far from 0."""
    least = _PEAK_SHARE * values[top]
    total = moment = 0.0
    for step in (-1, 1):
        k = top if step > 0 else top - 1
        while 0 <= k < len(values) and abs(k - top) <= _PEAK_COLUMNS:
            weight = (values[k] - least) * math.copysign(1.0, values[top])
            if weight <= 0.0:
                break
            total += weight
            moment += weight * k
            k += step
    return moment / total


@compiled
def dark_width(darkness: Array, row: int, middle: float) -> float:
    """Return how wide what is dark in a row is, about a place, without its blur [px].

    That is where it is half as dark as at its darkest; the sharper of its edges says what of that
    is blur, as if bar and blur were both bell-shaped.

    Parameters
    ----------
    darkness : ndarray, shape (rows, columns)
        From `fine_strip`.
    row : int
        Which row.
    middle : float
        The place [px from the strip's middle].
    """
    columns = darkness.shape[1]
    begin = min(max(round(middle / STEP_PX) + columns // 2, 0), columns - 1)
    largest = max(darkness[row, begin], 1e-9)
    edges = (begin, begin)
    for _ in range(2):
        # The second time with what is darkest between them.
        edges = (
            fall_from(darkness, row, begin, -1, 0.5 * largest),
            fall_from(darkness, row, begin, 1, 0.5 * largest),
        )
        for j in range(edges[0] + 1, edges[1]):
            largest = max(largest, darkness[row, j])
    sharpest = np.inf
    for k in range(2):
        side = 2 * k - 1
        outer = fall_from(darkness, row, edges[k] - side, side, 0.25 * largest)
        inner = edges[k] - side
        while inner != begin and darkness[row, inner] < 0.75 * largest:
            inner -= side
        sharpest = min(sharpest, STEP_PX * abs(outer - inner))
    half = STEP_PX * (edges[1] - edges[0] - 1)
    return math.sqrt(max(half * half - (_BELL * sharpest) ** 2, 0.0))


@compiled
def fall_from(darkness: Array, row: int, begin: int, side: int, level: float) -> int:
    """Return the first column on a side, from another on, that is no darker than a level."""
    j = begin
    while 0 <= j < darkness.shape[1] and darkness[row, j] > level:
        j += side
    return j
