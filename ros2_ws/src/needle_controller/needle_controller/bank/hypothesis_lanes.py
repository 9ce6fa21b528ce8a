"""How a bank keeps its estimates: in blocks of eight, side by side, one row for each number.

What is done to one estimate is done to the eight of a block in the same instructions. A block is
one array of `BLOCK` numbers; row r of it begins at r, lane h of the row is at r + h.
"""

from __future__ import annotations

import numpy as np

from needle_controller.model.arrays import Array

# Read by compiled code.
LANES = 8
"""Estimates in a block."""
ERROR = 8
"""Length of the error: position and rotation vector, both along the axes of `target_plane` (the
true rotation is exp(error) R), curvature, size of the torsion."""
(
    X, Y, Z,
    R00, R01, R02, R10, R11, R12, R20, R21, R22,
    P00,
    P10, P11,
    P20, P21, P22,
    P30, P31, P32, P33,
    P40, P41, P42, P43, P44,
    P50, P51, P52, P53, P54, P55,
    P60, P61, P62, P63, P64, P65, P66,
    P70, P71, P72, P73, P74, P75, P76, P77,
    KAPPA, PLAY, LAG, TIP_ANGLE, BEHIND_PLAY, PER_SIZE, KIND, WEIGHT,
    TURN_X, TURN_Y, TURN_Z, SIZE_CHANGE, SURPRISE,
) = range(0, 61 * LANES, LANES)  # fmt: skip
"""Rows: the tip [m], its orientation, the lower half of the error's covariance, curvature [1/m],
play [rad], lag length [m], angles of the tip and of the shaft behind the play since the start
[rad], derivative of the tip's angle with respect to the torsion's size, number of the torsion
hypothesis, weight; then what is written and read within one call."""
BLOCK = 61 * LANES
"""Length of a block."""
_LOWER = np.tril_indices(ERROR)


def blocks_for(count: int) -> int:
    """Return how many blocks hold so many estimates."""
    return -(-count // LANES)


def rows(state: Array, first: int, count: int) -> Array:
    """Return some rows of all estimates, shape (N, H, count), H being a multiple of `LANES`.

    Parameters
    ----------
    state : ndarray, shape (N, blocks, BLOCK)
        The blocks.
    first, count : int
        The first row, and how many.
    """
    needles, blocks = state.shape[:2]
    picked = state[:, :, first : first + count * LANES].reshape(needles, blocks, count, LANES)
    return np.asarray(np.swapaxes(picked, 2, 3).reshape(needles, blocks * LANES, count))


def set_rows(state: Array, first: int, values: Array) -> None:
    """Write rows of all estimates: the inverse of `rows`, values of shape (N, H, count)."""
    needles, blocks = state.shape[:2]
    count = values.shape[-1]
    lanes = np.swapaxes(values.reshape(needles, blocks, LANES, count), 2, 3)
    state[:, :, first : first + count * LANES] = lanes.reshape(needles, blocks, count * LANES)


def covariances(state: Array) -> Array:
    """Return the whole covariances of all estimates, shape (N, H, 8, 8)."""
    lower = rows(state, P00, len(_LOWER[0]))
    whole = np.empty((*lower.shape[:2], ERROR, ERROR))
    whole[..., _LOWER[0], _LOWER[1]] = lower
    whole[..., _LOWER[1], _LOWER[0]] = lower
    return whole


def set_covariances(state: Array, covariance: Array) -> None:
    """Write the covariances of all estimates, shape (N, H, 8, 8), symmetric."""
    set_rows(state, P00, covariance[..., _LOWER[0], _LOWER[1]])
