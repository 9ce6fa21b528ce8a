"""Search one camera's maps for ends that a shaft joins to the entry, by dynamic programming.

The needle runs outwards from the entry, so each row of the polar search grid holds one cell of it.
A path's score is the log-likelihood ratio of its cells, shaft against floor, plus that of an end
where it stops.
"""

# Compiled functions take plain numbers, one by one.
# ruff: noqa: PLR0917

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled, inlined
from needle_tracker.detector.search_grid import SearchGrid

Array = NDArray[np.float64]
Map = NDArray[np.float32]
Cells = NDArray[np.int64]

CANDIDATES = 10
"""Ends per view that are looked at more closely."""
_ROW_WEIGHT = 0.25  # neighbouring rows say much the same: they count for a quarter
_LOG_RATIO = 2.0  # of one row, at most
# Shares of the training's pixels that are shaft, and ends in the window about a cell: the network's
# probabilities over these are likelihood ratios.
_SHAFT_PRIOR, _ENDS_PRIOR = 0.04, 1.5e-3
_LATE_START = -4.0  # score of a path that begins away from the entry
_SURE = 6.0  # most of a path: a longer shaft is no surer, or long lines would hide short needles
_HIDDEN_END = 0.05  # likelihood ratio of an end that the network does not see
_MAX_SLOPE = 1.0  # sideways per outwards: 45 deg from the radius, pre-bend included
_APART = 0.8e-3  # between two ends of one view [m]
_DIRECTION_ROWS = 8  # rows that give a path's direction at its end


@dataclasses.dataclass(frozen=True, eq=False)
class ShaftPath:
    """A path from the entry to what may be the needle's end, in one image.

    Attributes
    ----------
    pixels : ndarray, shape (n, 2)
        From the entry outwards, the end last, good to about a cell of the grid [px].
    score : float
        Log-likelihood ratio of shaft and end.
    shaft : float
        Mean probability of shaft along it.
    """

    pixels: Array
    score: float
    shaft: float

    @property
    def end(self) -> Array:
        """Return the last pixel, shape (2,)."""
        return np.asarray(self.pixels[-1])

    @property
    def direction(self) -> Array:
        """Return the unit vector towards the end, shape (2,)."""
        ahead = self.pixels[-1] - self.pixels[max(len(self.pixels) - 1 - _DIRECTION_ROWS, 0)]
        return np.asarray(ahead / max(float(np.linalg.norm(ahead)), 1e-9))


def find_paths(
    grid: SearchGrid, shaft: Map, ends: Map, first_end: int, last_end: int
) -> list[ShaftPath]:
    """Return the paths with the largest scores, the best first, their ends apart.

    Parameters
    ----------
    grid : SearchGrid
        The camera's grid.
    shaft, ends : ndarray of float32, shape (rows, columns)
        The network's maps at the cells of the grid's first rows.
    first_end, last_end : int
        First and last row in which a path may end.
    """
    rows = min(last_end + 1, len(shaft))
    pitch = grid.distances[:rows] * grid.angle_pitch
    steps = np.maximum(1, np.ceil(_MAX_SLOPE * grid.row_pitch / pitch)).astype(np.int64)
    apart = np.ceil(_APART / pitch).astype(np.int64)
    cells, lengths, scores = _best_paths(
        shaft[:rows],
        ends[:rows],
        grid.reachable[:rows],
        steps,
        apart,
        math.ceil(_APART / grid.row_pitch),
        max(first_end, 1),
        CANDIDATES,
    )
    found = []
    for columns, length, score in zip(cells, lengths, scores, strict=True):
        if length:
            inside = np.arange(length), columns[:length]
            pixels = grid.pixels[inside].astype(np.float64)
            found.append(ShaftPath(pixels, float(score), float(shaft[inside].mean())))
    return found


@compiled
def _best_paths(
    shaft: Map,
    ends: Map,
    reachable: NDArray[np.bool_],
    steps: Cells,
    apart: Cells,
    rows_apart: int,
    first_end: int,
    count: int,
) -> tuple[Cells, Cells, Array]:
    """Return each path's columns, its number of rows (0: no path) and its score."""
    rows, columns = shaft.shape
    total = _accumulated(shaft, reachable, steps)
    score = np.full((rows, columns), -np.inf)
    for i in range(first_end, rows):
        for j in range(columns):
            if reachable[i, j]:
                score[i, j] = total[i, j] + math.log(ends[i, j] / _ENDS_PRIOR + _HIDDEN_END)
    # An end is better than all places about it, those farther along its own shaft among them.
    peaks = np.full((rows, columns), -np.inf)
    for i in range(first_end, rows):
        for j in range(columns):
            if score[i, j] > 0.0 and _is_peak(score, i, j, rows_apart, apart[i]):
                peaks[i, j] = score[i, j]
    cells = np.zeros((count, rows), np.int64)
    lengths = np.zeros(count, np.int64)
    scores = np.zeros(count)
    for n in range(count):
        end, column = divmod(int(peaks.argmax()), columns)
        if not peaks[end, column] > 0.0:
            break
        lengths[n], scores[n] = end + 1, peaks[end, column]
        peaks[end, column] = -np.inf
        _read_back(total, steps, end, column, cells[n])
    return cells, lengths, scores


@compiled
def _accumulated(shaft: Map, reachable: NDArray[np.bool_], steps: Cells) -> Array:
    """Return the largest log-likelihood ratio of all paths to each cell.

    total[i, j] = min(ratio(shaft[i, j]) + max(total[i - 1, j - step ... j + step], late), sure)
    """
    rows, columns = shaft.shape
    total = np.zeros((rows, columns))
    prior = math.log(_SHAFT_PRIOR / (1.0 - _SHAFT_PRIOR))
    for i in range(rows):
        for j in range(columns):
            if i:
                total[i, j] = _LATE_START
                for k in range(max(j - steps[i], 0), min(j + steps[i] + 1, columns)):
                    total[i, j] = max(total[i, j], total[i - 1, k])
            # A cell outside the image says nothing.
            if reachable[i, j]:
                chance = min(max(shaft[i, j], 1e-3), 1.0 - 1e-3)
                ratio = math.log(chance / (1.0 - chance)) - prior
                total[i, j] += _ROW_WEIGHT * min(max(ratio, -_LOG_RATIO), _LOG_RATIO)
                total[i, j] = min(total[i, j], _SURE)
    return total


@compiled
def _read_back(total: Array, steps: Cells, end: int, column: int, cells: Cells) -> None:
    """Write the columns of the path that ends in a cell."""
    columns = total.shape[1]
    cells[end] = column
    for i in range(end, 0, -1):
        # Of equals the straightest.
        chosen, largest = column, total[i - 1, column]
        for away in range(1, steps[i] + 1):
            for k in (column - away, column + away):
                if 0 <= k < columns and total[i - 1, k] > largest:
                    chosen, largest = k, total[i - 1, k]
        column = chosen
        cells[i - 1] = column


@inlined
def _is_peak(score: Array, row: int, column: int, rows_apart: int, apart: int) -> bool:
    """Return whether no score about a cell is above its own; of equals the first is the peak."""
    rows, columns = score.shape
    own = score[row, column]
    for i in range(max(row - rows_apart, 0), min(row + rows_apart + 1, rows)):
        for j in range(max(column - apart, 0), min(column + apart + 1, columns)):
            first = i < row or (i == row and j < column)
            if score[i, j] > own or (first and score[i, j] == own):
                return False
    return True
