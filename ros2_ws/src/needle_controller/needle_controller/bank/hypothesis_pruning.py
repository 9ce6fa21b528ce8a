"""Which of a needle's hypotheses go: the unlikely ones, and those that have become the same."""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import math

import numpy as np

from needle_common.compiled import compiled
from needle_controller.bank.hypothesis_lanes import (
    BLOCK,
    ERROR,
    KAPPA,
    KIND,
    LAG,
    LANES,
    P00,
    PLAY,
    R00,
    R01,
    R02,
    R10,
    R20,
    WEIGHT,
    X,
    Y,
    Z,
)
from needle_controller.bank.tip_update import rotate
from needle_controller.model.arrays import Array

_SAME_LAG = 0.001


@compiled
def prune(state: Array, alive: int, smallest_weight: float) -> int:
    """End hypotheses that became unlikely; make the largest weight 1; return how many are left."""
    largest = 0.0
    for h in range(alive):
        largest = max(largest, state[h // LANES, WEIGHT + h % LANES])
    h = 0
    while h < alive:
        weight = state[h // LANES, WEIGHT + h % LANES] / largest
        state[h // LANES, WEIGHT + h % LANES] = weight
        if weight < smallest_weight:
            alive = _remove(state, alive, h)
        else:
            h += 1
    return alive


@compiled
def merge(state: Array, alive: int, angle: float) -> int:
    """Join hypotheses of the same torsion that have become the same; return how many are left."""
    cosine, difference = math.cos(angle), np.empty(ERROR)
    first = 0
    while first < alive:
        a, i = state[first // LANES], first % LANES
        second = first + 1
        while second < alive:
            b, j = state[second // LANES], second % LANES
            if a[KIND + i] == b[KIND + j] and _same(a, i, b, j, cosine, angle):
                _join(a, i, b, j, difference)
                alive = _remove(state, alive, second)
            else:
                second += 1
        first += 1
    return alive


@compiled
def _same(a: Array, i: int, b: Array, j: int, cosine: float, angle: float) -> bool:
    """Return whether two hypotheses are one: rolls, pitches and sizes of the torsion are near."""
    along = a[R00 + i] * b[R00 + j] + a[R01 + i] * b[R01 + j] + a[R02 + i] * b[R02 + j]
    return bool(
        along > cosine
        and abs(a[R02 + i] - b[R02 + j]) < 0.25 * angle
        and abs(a[PLAY + i] - b[PLAY + j]) < 0.5 * angle
        and abs(a[LAG + i] - b[LAG + j]) < _SAME_LAG
    )


@compiled
def _join(a: Array, i: int, b: Array, j: int, difference: Array) -> None:
    """Put one estimate in the place of the first of two, with their common mean and covariance."""
    weight = a[WEIGHT + i] + b[WEIGHT + j]
    share = b[WEIGHT + j] / weight
    difference[0], difference[1] = b[X + j] - a[X + i], b[Y + j] - a[Y + i]
    difference[2] = b[Z + j] - a[Z + i]
    # R_b R_a^T, a small turn, as a vector.
    difference[3] = 0.5 * (_row_product(b, j, R20, a, i, R10) - _row_product(b, j, R10, a, i, R20))
    difference[4] = 0.5 * (_row_product(b, j, R00, a, i, R20) - _row_product(b, j, R20, a, i, R00))
    difference[5] = 0.5 * (_row_product(b, j, R10, a, i, R00) - _row_product(b, j, R00, a, i, R10))
    difference[6] = b[KAPPA + j] - a[KAPPA + i]
    difference[7] = b[PLAY + j] - a[PLAY + i] + b[LAG + j] - a[LAG + i]
    between = share * (1.0 - share)
    row = P00
    for k in range(ERROR):
        for m in range(k + 1):
            a[row + i] += (
                share * (b[row + j] - a[row + i]) + between * difference[k] * difference[m]
            )
            row += LANES
    rotate(a, i, share * difference[3], share * difference[4], share * difference[5])
    for k in range(3):
        a[X + k * LANES + i] += share * difference[k]
    for row in range(KAPPA, KIND, LANES):
        a[row + i] += share * (b[row + j] - a[row + i])
    a[WEIGHT + i] = weight


@compiled
def _row_product(b: Array, j: int, row: int, a: Array, i: int, other: int) -> float:
    """Return one element of R_b R_a^T: the product of two rows of the matrices."""
    return float(
        b[row + j] * a[other + i]
        + b[row + LANES + j] * a[other + LANES + i]
        + b[row + 2 * LANES + j] * a[other + 2 * LANES + i]
    )


@compiled
def _remove(state: Array, alive: int, h: int) -> int:
    """End a hypothesis: the last one takes its place, with the weight as it is there."""
    last = alive - 1
    if h != last:
        _copy(state, last, h)
    state[last // LANES, WEIGHT + last % LANES] = 0.0
    return last


@compiled
def _copy(state: Array, source: int, target: int) -> None:
    a, b = state[source // LANES], state[target // LANES]
    i, j = source % LANES, target % LANES
    for row in range(0, BLOCK, LANES):
        b[row + j] = a[row + i]
