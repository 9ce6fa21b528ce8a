"""One insertion on SE(3) with what it does to an estimate's covariance; compiled.

The tip moves by T <- T exp((V1 scale dl + V2 dtheta)^), [KC09] (2). The error changes by a few
terms "one element gains a multiple of another", each of which is one line for the covariance.
"""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

from needle_controller.bank.estimate_tiles import (
    BEHIND_PLAY,
    E_KAPPA,
    E_POSITION,
    E_SCALE,
    E_SIZE,
    E_TURN,
    ERROR,
    KAPPA,
    LAG,
    PER_SIZE,
    PLACE,
    PLAY,
    SCALE,
    TIP_ANGLE,
    R,
    X,
)
from needle_controller.bank.filter_settings import Drift
from needle_controller.bank.torsion_model import turn_tip
from needle_controller.model.arrays import Array
from needle_core.compiled import compiled, inlined

LARGEST_TURN = 1.0
"""Most that an advance may turn the base at once [rad]; larger ones are to be divided."""
_TURNED, _SIZE_CHANGE, _A, _B, _C, _HEADING, _SHIFT, _GAIN, _FACTOR = 0, 1, 2, 3, 4, 5, 8, 11, 14
MOTION_ROWS = 18
"""Rows of working memory: the tip's turn, how that changes with the torsion's size, Rodrigues'
factors; per axis the mean heading, and how position and orientation change with the curvature."""


@inlined
def rotation_factors(squared: float) -> tuple[float, float, float]:
    """Return sin(a)/a, (1 - cos(a))/a^2, (a - sin(a))/a^3 of a^2: Rodrigues' formula's factors.

    Series, right to 5e-8 of themselves up to a = 2.
    """
    q = squared
    first = 1.0 - q / 72.0 * (1.0 - q / 110.0 * (1.0 - q / 156.0))
    first = 1.0 - q / 6.0 * (1.0 - q / 20.0 * (1.0 - q / 42.0 * first))
    second = 1.0 - q / 90.0 * (1.0 - q / 132.0 * (1.0 - q / 182.0))
    second = 0.5 * (1.0 - q / 12.0 * (1.0 - q / 30.0 * (1.0 - q / 56.0 * second)))
    third = 1.0 - q / 110.0 * (1.0 - q / 156.0 * (1.0 - q / 210.0))
    third = (1.0 - q / 20.0 * (1.0 - q / 42.0 * (1.0 - q / 72.0 * third))) / 6.0
    return first, second, third


@compiled
def move(tile: Array, base: Array, turn: Array, length: Array, drift: Drift, work: Array) -> None:
    """Move a tile's tips by what the bases did, and their covariances: P <- F P F^T + Q.

    The poses move exactly; how they depend on the curvature is right up to (kappa length)^2. Where
    nothing was inserted or turned nothing changes, to the last bit.

    Parameters
    ----------
    tile : ndarray, shape (ROWS, LANES), changed
        The estimates.
    base, turn : ndarray, shape (LANES,)
        Angle of the base before, and how far it turns [rad], at most `LARGEST_TURN`.
    length : ndarray, shape (LANES,)
        Inserted length [m].
    drift : Drift
        What grows uncertain on the way.
    work : ndarray, shape (MOTION_ROWS, LANES)
        Working memory.
    """
    lanes = tile.shape[1]
    for h in range(lanes):
        tip, behind, per_size = turn_tip(
            tile[TIP_ANGLE, h],
            tile[BEHIND_PLAY, h],
            tile[PER_SIZE, h],
            base[h],
            turn[h],
            length[h],
            tile[PLAY, h],
            tile[LAG, h],
        )
        work[_TURNED, h] = tip - tile[TIP_ANGLE, h]
        work[_SIZE_CHANGE, h] = per_size - tile[PER_SIZE, h]
        tile[TIP_ANGLE, h], tile[BEHIND_PLAY, h], tile[PER_SIZE, h] = tip, behind, per_size
        bend, turned = tile[KAPPA, h] * tile[SCALE, h] * length[h], work[_TURNED, h]
        a, b, c = rotation_factors(bend * bend + turned * turned)
        work[_A, h], work[_B, h], work[_C, h] = a, b, c
    for axis in range(3):
        _move_axis(tile, axis, length, work)
    _spread_to_position(tile, length, work)
    _spread_to_orientation(tile, work)
    for axis in range(3):
        _add(tile, E_TURN + axis, length, drift.orientation)
    _add(tile, E_KAPPA, length, drift.curvature)
    _add(tile, E_SCALE, length, drift.scale)
    row = PLACE[E_SIZE, E_SIZE]
    for h in range(lanes):
        of_size = drift.lag if tile[LAG, h] > 0.0 else drift.play
        tile[row, h] += of_size * length[h] if tile[row, h] > 0.0 else 0.0


@inlined
def _move_axis(tile: Array, axis: int, length: Array, work: Array) -> None:
    """Move one coordinate, and turn one row of the orientation: R <- R exp((bend, 0, turn)^)."""
    row = R + 3 * axis
    for h in range(tile.shape[1]):
        scale = tile[SCALE, h]
        gone = scale * length[h]
        x, z = tile[KAPPA, h] * gone, work[_TURNED, h]
        a, b, c = work[_A, h], work[_B, h], work[_C, h]
        r0, r1, r2 = tile[row, h], tile[row + 1, h], tile[row + 2, h]
        heading = c * x * z * r0 - b * x * r1 + (1.0 - c * x * x) * r2
        work[_HEADING + axis, h] = heading
        # By the curvature: of the position, and of the orientation.
        work[_SHIFT + axis, h] = gone * gone * (c * z * r0 - b * r1 - 2.0 * c * x * r2)
        work[_GAIN + axis, h] = gone * ((1.0 - c * z * z) * r0 + b * z * r1 + c * x * z * r2)
        tile[X + axis, h] += gone * heading
        tile[row, h] = (1.0 - b * z * z) * r0 + a * z * r1 + b * x * z * r2
        tile[row + 1, h] = (1.0 - b * (x * x + z * z)) * r1 - a * z * r0 + a * x * r2
        tile[row + 2, h] = (1.0 - b * x * x) * r2 + b * x * z * r0 - a * x * r1


@inlined
def _spread_to_position(tile: Array, length: Array, work: Array) -> None:
    """Carry the position: a turn w of the start moves the end by w x s."""
    for axis in range(3):
        left, right = (axis + 1) % 3, (axis + 2) % 3
        for h in range(tile.shape[1]):
            scale, by_kappa = tile[SCALE, h], work[_SHIFT + axis, h]
            by_scale = tile[KAPPA, h] / scale * by_kappa
            work[_FACTOR, h] = scale * length[h] * work[_HEADING + right, h]
            work[_FACTOR + 1, h] = -scale * length[h] * work[_HEADING + left, h]
            work[_FACTOR + 2, h] = by_kappa
            work[_FACTOR + 3, h] = length[h] * work[_HEADING + axis, h] + by_scale
        gain(tile, E_POSITION + axis, (E_TURN + left, E_TURN + right, E_KAPPA, E_SCALE), work)


@inlined
def _spread_to_orientation(tile: Array, work: Array) -> None:
    """Carry the orientation: by the curvature, and about the heading by the torsion's size."""
    for axis in range(3):
        for h in range(tile.shape[1]):
            by_kappa = work[_GAIN + axis, h]
            work[_FACTOR, h] = by_kappa
            work[_FACTOR + 1, h] = work[_SIZE_CHANGE, h] * work[_HEADING + axis, h]
            work[_FACTOR + 2, h] = tile[KAPPA, h] / tile[SCALE, h] * by_kappa
            work[_FACTOR + 3, h] = 0.0
        gain(tile, E_TURN + axis, (E_KAPPA, E_SIZE, E_SCALE, E_SCALE), work)


@inlined
def gain(tile: Array, to: int, of: tuple[int, int, int, int], work: Array) -> None:
    """Let one element of the error gain multiples of four others, in the covariance.

    Parameters
    ----------
    tile : ndarray, shape (ROWS, LANES), changed
        The estimates.
    to, of : int
        Which element, and which others.
    work : ndarray, shape (MOTION_ROWS, LANES)
        The multiples are in the rows from `_FACTOR` on.
    """
    _gain_row(tile, PLACE[to, to], to, of, work)
    for k in range(ERROR):
        if k != to:
            _gain_row(tile, PLACE[to, k], k, of, work)
    # What it has with the others has changed: the second half of its variance.
    _gain_row(tile, PLACE[to, to], to, of, work)


@inlined
def _gain_row(tile: Array, target: int, k: int, of: tuple[int, int, int, int], work: Array) -> None:
    a, b, c, d = PLACE[of[0], k], PLACE[of[1], k], PLACE[of[2], k], PLACE[of[3], k]
    for h in range(tile.shape[1]):
        tile[target, h] += (
            work[_FACTOR, h] * tile[a, h]
            + work[_FACTOR + 1, h] * tile[b, h]
            + work[_FACTOR + 2, h] * tile[c, h]
            + work[_FACTOR + 3, h] * tile[d, h]
        )


@inlined
def _add(tile: Array, element: int, length: Array, variance_per_length: float) -> None:
    row = PLACE[element, element]
    for h in range(tile.shape[1]):
        tile[row, h] += variance_per_length * length[h]
