"""The paths outwards through a grid with the largest sums of evidence, by dynamic programming."""

# Compiled functions take plain numbers, one by one.
# ruff: noqa: PLR0912, PLR0917

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled, inlined

Ridge = NDArray[np.float32]
Rows = NDArray[np.int64]

_IMPOSSIBLE = np.float32(-1e6)
_STRENGTH = 0.3  # a clear line counts for more than a faint one
_OWN_ROWS = 24  # near its end a path has its cells for itself


@compiled
def best_paths(
    ridge: Ridge,
    reachable: NDArray[np.bool_],
    steps: Rows,
    widths: Rows,
    sign: np.float32,
    threshold: np.float32,
    spent: np.float32,
    first_end: int,
    count: int,
) -> tuple[Rows, Rows, NDArray[np.float64]]:
    """Return the paths with the most evidence, one after the other.

    A path starts in the first row, ends in `first_end` or later and moves at most `steps[row]`
    columns sideways from a row to the next. What one path has used near its end is worth nothing
    to the next: where two lines cross, both are followed.

    Parameters
    ----------
    ridge : ndarray of float32, shape (rows, columns)
        How much brighter each cell is than its surroundings [grey levels].
    reachable : ndarray of bool, shape (rows, columns)
        Where a path can be.
    steps, widths : ndarray of int, shape (rows,)
        Largest sideways step to each row, and how far beside its cells a path has them for itself.
    sign : float32
        1 for bright paths, -1 for dark ones.
    threshold : float32
        A ridge above it is evidence for a path, one below against it [grey levels].
    spent : float32
        A path has ended where so much of its sum is lost again; infinite: nowhere [grey levels].
    first_end : int
        First row in which a path may end.
    count : int
        Most paths.

    Returns
    -------
    cells : ndarray of int, shape (count, rows)
        Columns of each path.
    ends : ndarray of int, shape (count,)
        Its last row; 0 where there is none.
    sums : ndarray, shape (count,)
        Its evidence, in units of the threshold.
    """
    rows, columns = ridge.shape
    evidence = np.empty((rows, columns), np.float32)
    for i in range(rows):
        for j in range(columns):
            value = -threshold
            if reachable[i, j]:
                over = sign * ridge[i, j] - threshold
                value = min(max(over, -threshold), 2.0 * threshold)
                value += _STRENGTH * min(max(over - 2.0 * threshold, 0.0), 8.0 * threshold)
            evidence[i, j] = value
    total, peak = np.empty((rows, columns), np.float32), np.empty((rows, columns), np.float32)
    _accumulate(evidence, steps, total, peak, spent, 0)
    fresh = max(first_end - _OWN_ROWS, 1)
    cells = np.zeros((count, rows), np.int64)
    lengths = np.zeros(count, np.int64)
    sums = np.zeros(count)
    for n in range(count):
        if n:
            _accumulate(evidence, steps, total, peak, spent, fresh)
        end, column, largest = 0, 0, np.float32(0.0)
        for i in range(first_end, rows):
            for j in range(columns):
                if total[i, j] > largest:
                    end, column, largest = i, j, total[i, j]
        if not largest > 0.0:
            break
        sums[n] = largest / threshold
        lengths[n] = end
        cells[n, end] = column
        for i in range(end, 0, -1):
            # Of equals the straightest: a flat stretch must not pull the path to one side.
            chosen, best = column, total[i - 1, column]
            for away in range(1, steps[i] + 1):
                for k in (column - away, column + away):
                    if 0 <= k < columns and total[i - 1, k] > best:
                        chosen, best = k, total[i - 1, k]
            column = chosen
            cells[n, i - 1] = column
        for i in range(fresh, end + 1):
            place = cells[n, i]
            evidence[i, max(place - widths[i], 0) : place + widths[i] + 1] = -threshold
    return cells, lengths, sums


@compiled
def _accumulate(
    evidence: Ridge, steps: Rows, total: Ridge, peak: Ridge, spent: np.float32, first: int
) -> None:
    """Fill `total` from a row on with the largest sums of evidence of paths to each cell.

    A path that has spent so much of its largest sum so far (`peak`) has ended: what lies beyond is
    another thing (the X-drop of sequence alignment: Altschul et al. 1990).
    """
    rows, columns = evidence.shape
    widest = columns + 2 * steps.max()
    one, other = np.empty(widest, np.float32), np.empty(widest, np.float32)
    for i in range(first, rows):
        if i == 0:
            total[i], peak[i] = evidence[i], _IMPOSSIBLE
            continue
        # The largest of two spans is that of one twice as long; each written to a place of its
        # own, so that many cells are done at once.
        step, span = steps[i], 1
        length = columns + 2 * step
        one[:step] = _IMPOSSIBLE
        one[step : step + columns] = total[i - 1]
        one[step + columns : length] = _IMPOSSIBLE
        while 2 * span <= 2 * step + 1:
            length -= span
            _larger(one, one[span:], other[:length])
            one, other = other, one
            span *= 2
        _larger(one, one[2 * step + 1 - span :], total[i])
        if spent < np.inf:
            _let_go(evidence[i], total[i], total[i - 1], peak[i], peak[i - 1], step, spent)
        total[i] += evidence[i]


@inlined
def _let_go(
    evidence: Ridge,
    total: Ridge,
    before: Ridge,
    peak: Ridge,
    peak_before: Ridge,
    step: int,
    spent: np.float32,
) -> None:
    """Make impossible what goes on from where too much is spent; `total` is yet to get its own."""
    columns = len(total)
    for j in range(columns):
        away, k = 0, j
        # Of equals the straightest, as the path is read back.
        while away <= step:
            if j - away >= 0 and before[j - away] == total[j]:
                k = j - away
                break
            if j + away < columns and before[j + away] == total[j]:
                k = j + away
                break
            away += 1
        now = total[j] + evidence[j]
        peak[j] = max(peak_before[k], now) if evidence[j] > 0.0 else peak_before[k]
        if now < peak[j] - spent:
            total[j] = peak[j] = _IMPOSSIBLE


@inlined
def _larger(some: Ridge, others: Ridge, result: Ridge) -> None:
    for j in range(len(result)):
        result[j] = max(some[j], others[j])
