"""Hypotheses of a needle that have become the same become one; compiled."""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import math

import numpy as np

from needle_controller.bank.estimate_tiles import (
    E_KAPPA,
    E_SCALE,
    E_SIZE,
    E_TURN,
    ERROR,
    KAPPA,
    KIND,
    LAG,
    LANES,
    PLACE,
    PLAY,
    REMAINDER,
    SCALE,
    SHAPE,
    WEIGHT,
    R,
    Tiles,
    X,
)
from needle_controller.bank.tip_update import rotate
from needle_controller.model.arrays import Array
from needle_core.compiled import compiled

_SAME_LAG = 0.001
_SHAPES = 3.0
_ENDED = -1.0
_X_X = PLACE[0, 0]


@compiled
def merge(tiles: Tiles, angle: float) -> None:
    """Join hypotheses of the same torsion that have become the same; one of them gets weight 0.

    Parameters
    ----------
    tiles : Tiles, changed
        The estimates of all needles.
    angle : float
        Between rolls that count as the same [rad].
    """
    cosine, difference = math.cos(angle), np.empty(ERROR)
    kind = np.empty(int(np.max(np.diff(tiles.first))))
    for n in range(tiles.first.size - 1):
        slots = tiles.slot[tiles.first[n] : tiles.first[n + 1]]
        for k, s in enumerate(slots):
            tile, h = tiles.state[s // LANES], s % LANES
            has_ended = tile[WEIGHT, h] == 0.0
            kind[k] = _ENDED if has_ended else tile[KIND, h] * _SHAPES + tile[SHAPE, h]
        for first in range(slots.size):
            a, i = tiles.state[slots[first] // LANES], slots[first] % LANES
            for second in range(first + 1, slots.size):
                if kind[second] != kind[first] or kind[first] == _ENDED:
                    continue
                b, j = tiles.state[slots[second] // LANES], slots[second] % LANES
                if _same(a, i, b, j, cosine, angle):
                    _join(a, i, b, j, difference)
                    kind[second] = _ENDED


@compiled
def _same(a: Array, i: int, b: Array, j: int, cosine: float, angle: float) -> bool:
    """Return whether two of a kind are one: rolls, pitches and sizes of the torsion are near."""
    along = a[R, i] * b[R, j] + a[R + 1, i] * b[R + 1, j] + a[R + 2, i] * b[R + 2, j]
    return bool(
        along > cosine
        and abs(a[R + 2, i] - b[R + 2, j]) < 0.25 * angle
        and abs(a[PLAY, i] - b[PLAY, j]) < 0.5 * angle
        and abs(a[LAG, i] - b[LAG, j]) < _SAME_LAG
        # Else one of them has jumped.
        and (a[X, i] - b[X, j]) ** 2 < max(a[_X_X, i], b[_X_X, j])
    )


@compiled
def _join(a: Array, i: int, b: Array, j: int, difference: Array) -> None:
    """Put one estimate in the place of the first of two, with their common mean and covariance."""
    weight = a[WEIGHT, i] + b[WEIGHT, j]
    share = b[WEIGHT, j] / weight
    for k in range(3):
        difference[k] = b[X + k, j] - a[X + k, i]
        # R_b R_a^T, a small turn, as a vector.
        left, right = R + 3 * ((k + 1) % 3), R + 3 * ((k + 2) % 3)
        turn = 0.0
        for m in range(3):
            turn += b[right + m, j] * a[left + m, i] - b[left + m, j] * a[right + m, i]
        difference[E_TURN + k] = 0.5 * turn
    difference[E_KAPPA] = b[KAPPA, j] - a[KAPPA, i]
    difference[E_SIZE] = b[PLAY, j] - a[PLAY, i] + b[LAG, j] - a[LAG, i]
    difference[E_SCALE] = b[SCALE, j] - a[SCALE, i]
    between = share * (1.0 - share)
    for k in range(ERROR):
        for m in range(k + 1):
            row = PLACE[k, m]
            a[row, i] += share * (b[row, j] - a[row, i]) + between * difference[k] * difference[m]
    rotate(a, i, share * difference[3], share * difference[4], share * difference[5])
    for k in range(3):
        a[X + k, i] += share * difference[k]
    for row in range(KAPPA, REMAINDER + 3):
        a[row, i] += share * (b[row, j] - a[row, i])
    a[WEIGHT, i], b[WEIGHT, j] = weight, 0.0
