"""Search of both images at once for shafts that run from the entry to an end.

A cell of the search grid has a pixel in each image, and its score is the sum over both: a shadow or
a line on the floor that only one view shows there gains nothing. The score of a path is the
log-likelihood ratio of its cells, shaft against floor, plus that of an end in its last cell;
dynamic programming maximizes it.
"""

# Compiled functions take plain numbers, one by one.
# ruff: noqa: PLR0917

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled
from needle_tracker.detector.needle_detector import NeedleDetector
from needle_tracker.detector.search_grid import Indices, SearchGrid

Array = NDArray[np.float64]
Scores = NDArray[np.float32]


@dataclasses.dataclass(frozen=True)
class SearchSettings:
    """Constants of the search; scores are natural logarithms of likelihood ratios.

    Attributes
    ----------
    shafts : int
        Number of shafts that are examined further.
    late_start : float
        Score of a path that begins away from the entry.
    path_limit : float
        Largest score of a path without its end, so that a long line does not hide a short needle.
    apart : int
        Number of columns within which the ends of two shafts count as one.
    """

    shafts: int = 12
    late_start: float = -8.0
    path_limit: float = 12.0
    apart: int = 2


SEARCH = SearchSettings()


@dataclasses.dataclass(frozen=True, eq=False)
class Shaft:
    """Path from the entry to a candidate for the end of the needle.

    Attributes
    ----------
    cells : ndarray of int, shape (n,)
        Cells of the search grid from the entry to the end.
    score : float
        Log-likelihood ratio of path and end.
    """

    cells: Indices
    score: float


def find_shafts(
    grid: SearchGrid,
    detectors: tuple[NeedleDetector, NeedleDetector],
    least: float,
    most: float,
    *,
    full_size: bool = False,
) -> list[Shaft]:
    """Return the paths with the largest scores and distinct ends, the best first.

    Parameters
    ----------
    grid : SearchGrid
        Grid of the rig.
    detectors : pair of NeedleDetector
        Left and right.
    least, most : float
        Bounds of the distance of the end from the entry [m].
    full_size : bool
        Whether to use the full size of the images for all of them.
    """
    first, last = grid.row_of(least), grid.row_of(most)
    starts = grid.starts[: last + 2]
    left, right = (
        detector.scores(grid, seen, last, full_size=full_size)
        for detector, seen in zip(detectors, grid.views, strict=True)
    )
    totals, before, first_rows = _accumulated(
        left[0] + right[0], starts, grid.columns, grid.side, SEARCH.late_start, SEARCH.path_limit
    )
    rows = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    # A shadow on the floor or a line beside the needle comes within reach far from the entry.
    scores = np.where(2 * first_rows <= rows, totals + left[1] + right[1], -np.inf)
    ends = _peaks(scores, starts, grid.columns, grid.side, max(first, 1), SEARCH.apart)
    best = ends[np.argsort(-scores[ends], kind="stable")][: SEARCH.shafts]
    return [Shaft(_read_back(before, int(end)), float(scores[end])) for end in best]


@compiled
def _accumulated(
    scores: Scores,
    starts: Indices,
    columns: Indices,
    side: int,
    late_start: float,
    path_limit: float,
) -> tuple[Scores, Indices, Indices]:
    """Return the largest score of all paths to each cell.

    Returned with it are the cell before it on that path, and the first row of that path.

    A path continues in the same or a neighbouring column of the next row:

    total[c] = min(score[c] + max(total[cells before c], late_start), path_limit)
    """
    totals, before = np.empty(len(scores), np.float32), np.full(len(scores), -1)
    first_rows = np.empty(len(scores), np.int64)
    # The cell in each column of the previous row and of this one, with a border of one column.
    behind, here = np.full((side + 2, side + 2), -1), np.full((side + 2, side + 2), -1)
    for row in range(len(starts) - 1):
        for cell in range(starts[row], starts[row + 1]):
            i, j = columns[cell, 0] + 1, columns[cell, 1] + 1
            here[i, j] = cell
            best = late_start if starts[row] > 0 else 0.0
            # Among equal totals, choose the straightest path.
            straight = behind[i, j]
            if straight >= 0 and totals[straight] >= best:
                best, before[cell] = totals[straight], straight
            for k in range(9):
                other = behind[i + k // 3 - 1, j + k % 3 - 1]
                if other >= 0 and totals[other] > best:
                    best, before[cell] = totals[other], other
            totals[cell] = min(best + scores[cell], path_limit)
            first_rows[cell] = first_rows[before[cell]] if before[cell] >= 0 else row
        behind, here = here, behind
        here[:] = -1
    return totals, before, first_rows


@compiled
def _peaks(
    scores: Scores, starts: Indices, columns: Indices, side: int, first_row: int, apart: int
) -> Indices:
    """Return the cells with a positive score that is the largest nearby; of equals, the first."""
    rows = len(starts) - 1
    dense = np.full((rows, side, side), -math.inf, np.float32)
    for row in range(first_row, rows):
        for cell in range(starts[row], starts[row + 1]):
            dense[row, columns[cell, 0], columns[cell, 1]] = scores[cell]
    found = np.empty(len(scores), np.int64)
    count = 0
    for row in range(first_row, rows):
        for cell in range(starts[row], starts[row + 1]):
            if scores[cell] > 0.0 and _is_peak(dense, row, columns[cell], apart):
                found[count] = cell
                count += 1
    return found[:count]


@compiled
def _is_peak(scores: Scores, row: int, column: Indices, apart: int) -> bool:
    rows, side = scores.shape[:2]
    own, (i, j) = scores[row, column[0], column[1]], (column[0], column[1])
    for near_row in range(max(row - 1, 0), min(row + 2, rows)):
        for near_i in range(max(i - apart, 0), min(i + apart + 1, side)):
            for near_j in range(max(j - apart, 0), min(j + apart + 1, side)):
                near = scores[near_row, near_i, near_j]
                if near > own or (near == own and (near_row, near_i, near_j) < (row, i, j)):
                    return False
    return True


def _read_back(before: Indices, end: int) -> Indices:
    """Return the cells of the path to an end, from the entry."""
    cells = [end]
    while before[cells[-1]] >= 0:
        cells.append(int(before[cells[-1]]))
    return np.array(cells[::-1])
