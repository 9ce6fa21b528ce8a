"""Memory layout of many needles' estimates: tiles, side by side, one row for each number.

Estimates fill tiles of `LANES`. What is done to one estimate is done to all of a tile in the same
instructions, whichever needle each belongs to, and the order of operations on a needle does not
depend on how many needles there are: a node and a study get the same bits. Those that think noise
of the same shape possible lie side by side, since what is reckoned for one lane is reckoned for
all. What fills the last tile has weight 0, as has an estimate that has ended.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_core.compiled import compiled

# Read by compiled code.
LANES = 64
"""Estimates in a tile."""
ERROR = 9
"""Length of the error: position and rotation vector, both along the axes of `target_plane` (the
true rotation is exp(error) R), curvature, size of the torsion, insertion scale."""
NOISES = 6
"""Most noise models of one shape."""
E_POSITION, E_TURN, E_KAPPA, E_SIZE, E_SCALE = 0, 3, 6, 7, 8
"""Where each begins in the error."""
PAIRS = ERROR * (ERROR + 1) // 2
X, R, P = 0, 3, 12
"""First rows of the tip [m], of its orientation row by row, and of the covariance's lower half."""
KAPPA, SCALE, PLAY, LAG, TIP_ANGLE, BEHIND_PLAY, PER_SIZE = range(P + PAIRS, P + PAIRS + 7)
"""Rows of curvature [1/m], insertion scale (length that the needle goes in per insertion), play
[rad], lag length [m], angles of the tip and of the shaft behind the play since the start [rad],
derivative of the tip's angle with respect to the torsion's size."""
NOISE = PER_SIZE + 1
"""First row of how likely each noise model is: of all coordinates, or of the first of three."""
REMAINDER = NOISE + 3 * NOISES
"""First row of the last tip minus what was then estimated of it [m]."""
KIND, SHAPE, WEIGHT, EVIDENCE, OUTLIER = range(REMAINDER + 3, REMAINDER + 8)
"""Rows of the torsion hypothesis's number, the shape that noise is thought to have, and the
weight; and, of the last tip, its likelihood and how likely it was an outlier (0 again where that
brought a displaced estimate)."""
ROWS = OUTLIER + 1
_LOWER = np.tril_indices(ERROR)
PLACE = np.zeros((ERROR, ERROR), dtype=np.int64)
"""Row of each element of the covariance."""
PLACE[_LOWER] = PLACE[_LOWER[::-1]] = P + np.arange(PAIRS)
# More room costs time with each tip; less turns displaced estimates away.
_ESTIMATES_PER_SPARE = 4


class Tiles(NamedTuple):
    """The estimates of all needles.

    Attributes
    ----------
    state : ndarray, shape (tiles, ROWS, LANES)
        The numbers; slot s is lane s % LANES of tile s // LANES.
    first : ndarray of int, shape (N + 1,)
        Each needle's first estimate, and the end of the last's.
    slot : ndarray of int, shape (first[-1],)
        Where each estimate lies.
    owner : ndarray of int, shape (tiles * LANES,)
        Whose needle's estimate lies in each slot.
    """

    state: Array
    first: npt.NDArray[np.int64]
    slot: npt.NDArray[np.int64]
    owner: npt.NDArray[np.int64]


def tiles_of(numbers: Array, counts: npt.NDArray[np.int64]) -> Tiles:
    """Return estimates in tiles.

    Parameters
    ----------
    numbers : ndarray, shape (M, ROWS)
        All estimates, needle by needle.
    counts : ndarray of int, shape (N,)
        How many each needle has, at least 1.
    """
    filling = -len(numbers) % LANES
    filled = np.concatenate([numbers, np.repeat(numbers[-1:], filling, axis=0)])
    state = np.ascontiguousarray(filled.reshape(-1, LANES, ROWS).transpose(0, 2, 1))
    return _picked(state, np.arange(len(numbers)), counts)


def rows(tiles: Tiles, first: int, count: int) -> Array:
    """Return some rows of all estimates, shape (M, count), the filling left out."""
    picked = tiles.state[:, first : first + count].transpose(0, 2, 1).reshape(-1, count)
    return np.asarray(picked[tiles.slot])


def set_rows(tiles: Tiles, first: int, values: Array) -> None:
    """Write rows of all estimates: the inverse of `rows`, values of shape (M, count)."""
    tiles.state[tiles.slot // LANES, first : first + values.shape[1], tiles.slot % LANES] = values


def tidied(tiles: Tiles) -> Tiles:
    """Return the tiles without most estimates of weight 0.

    Room for new ones stays: one of weight 0 for each needle, and one more for every fourth that has
    a weight.
    """
    picked, counts = np.empty_like(tiles.slot), np.zeros(len(tiles.first) - 1, dtype=np.int64)
    count = _pick(tiles, picked, counts)
    if count == tiles.first[-1]:
        return tiles
    return _picked(tiles.state, picked[:count], counts)


def repeated(tiles: Tiles, needles: int) -> Tiles:
    """Return the estimates of the only needle as those of so many."""
    count = int(tiles.first[-1])
    return _picked(tiles.state, np.tile(tiles.slot, needles), np.full(needles, count))


def _picked(state: Array, picked: npt.NDArray[np.int64], counts: npt.NDArray[np.int64]) -> Tiles:
    """Return what lies in some slots, (M,), as estimates of needles with so many each, (N,)."""
    order = np.argsort(state[picked // LANES, SHAPE, picked % LANES], kind="stable")
    slot = np.empty_like(order)
    slot[order] = np.arange(len(order))
    filling = -len(order) % LANES
    order = np.concatenate([order, np.repeat(order[-1:], filling)])
    gathered = np.empty((len(order) // LANES, ROWS, LANES))
    _gather(state, picked[order], gathered)
    gathered[-1, WEIGHT, LANES - filling :] = 0.0
    first = np.concatenate([[0], np.cumsum(counts)])
    return Tiles(gathered, first, slot, np.repeat(np.arange(len(counts)), counts)[order])


def covariances(tiles: Tiles) -> Array:
    """Return the whole covariances of all estimates, shape (M, 9, 9)."""
    lower = rows(tiles, P, PAIRS)
    whole = np.empty((len(lower), ERROR, ERROR))
    whole[:, _LOWER[0], _LOWER[1]] = lower
    whole[:, _LOWER[1], _LOWER[0]] = lower
    return whole


def lower_half(covariance: Array) -> Array:
    """Return the rows of symmetric matrices, (..., 9, 9) to (..., 45): undoes `covariances`."""
    return covariance[..., _LOWER[0], _LOWER[1]]


@compiled
def _pick(tiles: Tiles, picked: npt.NDArray[np.int64], counts: npt.NDArray[np.int64]) -> int:
    """Write the slots of what stays, and how many of each needle do; return how many in all."""
    count = 0
    for n in range(counts.size):
        slots, alive = tiles.slot[tiles.first[n] : tiles.first[n + 1]], 0
        for s in slots:
            if tiles.state[s // LANES, WEIGHT, s % LANES] > 0.0:
                alive += 1
        spare = 1 + alive // _ESTIMATES_PER_SPARE
        before = count
        # In their order, as where nothing goes: it must not depend on the other needles.
        for s in slots:
            has_ended = tiles.state[s // LANES, WEIGHT, s % LANES] == 0.0
            if has_ended and spare == 0:
                continue
            picked[count] = s
            count += 1
            spare -= has_ended
        counts[n] = count - before
    return count


@compiled
def _gather(state: Array, picked: npt.NDArray[np.int64], target: Array) -> None:
    for t in range(target.shape[0]):
        of_tile = picked[t * LANES : (t + 1) * LANES]
        for row in range(ROWS):
            for h in range(LANES):
                target[t, row, h] = state[of_tile[h] // LANES, row, of_tile[h] % LANES]
