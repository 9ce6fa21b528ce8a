"""Search of the maps of one camera for ends that a shaft connects to the entry.

The needle runs outwards from the entry, so it has one cell in each row of the polar search grid.
The score of a path is the log-likelihood ratio of its cells, shaft against floor, plus that of an
end in its last cell; dynamic programming maximizes it.
"""

# Compiled functions take plain numbers, one by one.
# ruff: noqa: PLR0917

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled, inlined
from needle_tracker.detector.end_fit import FIT
from needle_tracker.detector.search_grid import SearchGrid

Array = NDArray[np.float64]
Map = NDArray[np.float32]
Cells = NDArray[np.int64]


@dataclasses.dataclass(frozen=True)
class SearchSettings:
    """Numbers of the search for paths; scores are natural logarithms of likelihood ratios.

    Attributes
    ----------
    candidates : int
        Ends of each view that are examined further.
    smooth_rows : int
        Rows over which the steps of the cells average out.
    shaft_prior, ends_prior : float
        Share of shaft among the pixels of the training, and ends in the window of a cell: the
        network's probabilities over these are likelihood ratios.
    row_weight : float
        Weight of a row, since neighbouring rows are correlated.
    row_limit : float
        Largest size of the score of one row.
    late_start : float
        Score of a path that begins away from the entry.
    path_limit : float
        Largest score of a shaft, so that a long line does not hide a short needle.
    """

    candidates: int = 10
    smooth_rows: int = 7
    shaft_prior: float = 0.04
    ends_prior: float = 1.5e-3
    row_weight: float = 0.25
    row_limit: float = 2.0
    late_start: float = -4.0
    path_limit: float = 6.0


SEARCH = SearchSettings()


@dataclasses.dataclass(frozen=True, eq=False)
class ShaftPath:
    """Path in one image from the entry to a candidate for the end of the needle.

    Attributes
    ----------
    pixels : ndarray, shape (n, 2)
        From the entry outwards, the end last, to the resolution of the grid [px].
    score : float
        Log-likelihood ratio of shaft and end.
    shaft : float
        Mean probability of shaft along the path.
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
        ahead = self.pixels[-1] - self.pixels[max(len(self.pixels) - 1 - SEARCH.smooth_rows, 0)]
        return np.asarray(ahead / np.linalg.norm(ahead))


def find_paths(
    grid: SearchGrid, shaft: Map, ends: Map, first_end: int, last_end: int
) -> list[ShaftPath]:
    """Return the paths with the largest scores and distinct ends, the best first.

    Parameters
    ----------
    grid : SearchGrid
        Grid of the camera.
    shaft, ends : ndarray of float32, shape (rows, columns)
        Maps at the cells of the first rows of the grid.
    first_end, last_end : int
        First and last row in which a path may end.
    """
    rows = min(last_end + 1, len(shaft))
    reachable = grid.reachable[:rows]
    pitch = grid.distances[:rows] * grid.angle_pitch
    # A path leaves the radius by at most 45 deg, the pre-bend included.
    steps = np.maximum(1, np.ceil(grid.row_pitch / pitch)).astype(np.int64)
    # Ends within two rows are one.
    apart = np.ceil(2.0 * grid.row_pitch / pitch).astype(np.int64)
    shaft_scores, end_scores = _scores(shaft[:rows], ends[:rows], reachable)
    cells, lengths, scores = _best_paths(
        shaft_scores,
        end_scores,
        steps,
        apart,
        max(first_end, 1),
        SEARCH.candidates,
        SEARCH.late_start,
        SEARCH.path_limit,
    )
    found = []
    for columns, length, score in zip(cells, lengths, scores, strict=True):
        if length:
            inside = np.arange(length), columns[:length]
            pixels = grid.pixels[inside].astype(np.float64)
            found.append(ShaftPath(pixels, float(score), float(shaft[inside].mean())))
    return found


def _scores(shaft: Map, ends: Map, reachable: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the log-likelihood ratios of shaft in each cell, and of an end in it.

    A cell outside the image has no shaft score and no end.
    """
    chance, prior = shaft.astype(np.float64), SEARCH.shaft_prior
    with np.errstate(divide="ignore"):
        ratio = np.log(chance / (1.0 - chance)) - math.log(prior / (1.0 - prior))
    limited = SEARCH.row_weight * np.clip(ratio, -SEARCH.row_limit, SEARCH.row_limit)
    end = np.log(ends.astype(np.float64) / SEARCH.ends_prior + FIT.hidden_end)
    return np.where(reachable, limited, 0.0), np.where(reachable, end, -np.inf)


@compiled
def _best_paths(
    shaft_scores: Array,
    end_scores: Array,
    steps: Cells,
    apart: Cells,
    first_end: int,
    count: int,
    late_start: float,
    path_limit: float,
) -> tuple[Cells, Cells, Array]:
    """Return each path's columns, its number of rows (0: no path) and its score."""
    rows, columns = shaft_scores.shape
    total = _accumulated(shaft_scores, steps, late_start, path_limit)
    score = total + end_scores
    score[:first_end] = -np.inf
    # A candidate is the best place about it, also along its own shaft.
    peaks = np.full((rows, columns), -np.inf)
    for i in range(first_end, rows):
        for j in range(columns):
            if score[i, j] > 0.0 and _is_peak(score, i, j, apart[i]):
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
def _accumulated(scores: Array, steps: Cells, late_start: float, path_limit: float) -> Array:
    """Return the largest score of all paths to each cell.

    total[i, j] = min(score[i, j] + max(total[i - 1, j - step ... j + step], late), limit)
    """
    rows, columns = scores.shape
    total = np.zeros((rows, columns))
    for i in range(rows):
        for j in range(columns):
            if i:
                total[i, j] = late_start
                for k in range(max(j - steps[i], 0), min(j + steps[i] + 1, columns)):
                    total[i, j] = max(total[i, j], total[i - 1, k])
            total[i, j] = min(total[i, j] + scores[i, j], path_limit)
    return total


@compiled
def _read_back(total: Array, steps: Cells, end: int, column: int, cells: Cells) -> None:
    """Write the columns of the path to a cell."""
    columns = total.shape[1]
    cells[end] = column
    for i in range(end, 0, -1):
        # Among equal totals, choose the straightest path.
        chosen, largest = column, total[i - 1, column]
        for away in range(1, steps[i] + 1):
            for k in (column - away, column + away):
                if 0 <= k < columns and total[i - 1, k] > largest:
                    chosen, largest = k, total[i - 1, k]
        column = chosen
        cells[i - 1] = column


@inlined
def _is_peak(score: Array, row: int, column: int, apart: int) -> bool:
    """Return whether a cell has the largest score about it; among equals, the first."""
    rows, columns = score.shape
    own = score[row, column]
    for i in range(max(row - 2, 0), min(row + 2 + 1, rows)):
        for j in range(max(column - apart, 0), min(column + apart + 1, columns)):
            first = i < row or (i == row and j < column)
            if score[i, j] > own or (first and score[i, j] == own):
                return False
    return True
