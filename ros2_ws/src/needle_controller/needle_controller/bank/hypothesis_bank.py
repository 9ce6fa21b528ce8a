"""Many needles, several Gaussian estimates of each: what is done to all of them; compiled.

Beside its estimates a needle has how likely each noise model is, and what became of its last tips.
Angles of base and tip count from the start.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from needle_controller.bank.estimate_tiles import (
    E_TURN,
    ERROR,
    EVIDENCE,
    LANES,
    OUTLIER,
    PLACE,
    REMAINDER,
    ROWS,
    WEIGHT,
    Tiles,
    X,
)
from needle_controller.bank.filter_settings import Drift, Limits
from needle_controller.bank.tip_motion import LARGEST_TURN, MOTION_ROWS, move
from needle_controller.bank.tip_update import (
    ALONG,
    BOUND,
    FOUND,
    READ,
    READING_ROWS,
    UPDATE_ROWS,
    take_tip,
)
from needle_controller.model.arrays import Array
from needle_core.compiled import compiled

_NEWEST_SHARE = 0.1


class Bank(NamedTuple):
    """The state of all estimates.

    Attributes
    ----------
    tiles : Tiles
        The estimates. The heaviest of a needle has weight 1.
    base : ndarray, shape (N,)
        Rotation of the base since the start [rad].
    refused : ndarray, shape (N,)
        How likely the last tip was an outlier.
    unexplained : ndarray, shape (N,)
        The same in the running mean of the last tips.
    """

    tiles: Tiles
    base: Array
    refused: Array
    unexplained: Array


@compiled
def advance_bank(bank: Bank, length: Array, turn: Array, longest_step: float, drift: Drift) -> None:
    """Move every estimate by what the base did.

    Parameters
    ----------
    bank : Bank, changed
        The estimates.
    length, turn : ndarray, shape (N,)
        Inserted length [m] and rotation of the base over it [rad].
    longest_step : float
        That is taken at once [m].
    drift : Drift
        What grows uncertain on the way.
    """
    parts = np.empty(length.size)
    for n in range(length.size):
        parts[n] = math.ceil(max(length[n] / longest_step, abs(turn[n]) / LARGEST_TURN, 1.0) - 1e-9)
    work = np.empty((MOTION_ROWS, LANES))
    base, step, share = np.empty(LANES), np.empty(LANES), np.empty(LANES)
    state, owner = bank.tiles.state, bank.tiles.owner
    for t in range(state.shape[0]):
        most = 1.0
        for h in range(LANES):
            most = max(most, parts[owner[t * LANES + h]])
        for part in range(int(most)):
            for h in range(LANES):
                n = owner[t * LANES + h]
                goes_on = part < parts[n]
                share[h] = turn[n] / parts[n] if goes_on else 0.0
                step[h] = length[n] / parts[n] if goes_on else 0.0
                base[h] = bank.base[n] + part * share[h]
            move(state[t], base, share, step, drift, work)
    for n in range(length.size):
        bank.base[n] += turn[n]


@compiled
def correct_bank(
    bank: Bank,
    reading: Array,
    noises: Array,
    limits: Limits,
) -> None:
    """Take one measured tip of every needle.

    Parameters
    ----------
    bank : Bank, changed
        The estimates.
    reading : ndarray, shape (N, READING_ROWS)
        The tips, as `take_tip` wants them.
    noises :
        As in `take_tip`.
    limits : Limits
        Of the estimates; what errors are reckoned with.
    """
    state, owner = bank.tiles.state, bank.tiles.owner
    work, seen = np.empty((UPDATE_ROWS, LANES)), np.empty((READING_ROWS, LANES))
    for t in range(state.shape[0]):
        for h in range(LANES):
            n = owner[t * LANES + h]
            for row in range(READING_ROWS):
                seen[row, h] = reading[n, row]
        take_tip(state[t], seen, noises, limits, work)
    for n in range(bank.base.size):
        if reading[n, FOUND] > 0.0:
            _judge(bank, n, reading[n], limits)


@compiled
def _judge(bank: Bank, n: int, reading: Array, limits: Limits) -> None:
    """Weigh a needle's hypotheses by its tip; end what is unlikely."""
    state = bank.tiles.state
    slots = bank.tiles.slot[bank.tiles.first[n] : bank.tiles.first[n + 1]]
    whole = largest = refused = 0.0
    for s in slots:
        tile, h = state[s // LANES], s % LANES
        weight = tile[WEIGHT, h] * tile[EVIDENCE, h]
        tile[WEIGHT, h] = weight
        whole += weight
        largest = max(largest, weight)
        refused += weight * tile[OUTLIER, h]
    refused /= whole
    for s in slots:
        tile, h = state[s // LANES], s % LANES
        weight = tile[WEIGHT, h] / largest
        tile[WEIGHT, h] = weight if weight > limits.smallest_weight else 0.0
    bank.refused[n] = refused
    bank.unexplained[n] += _NEWEST_SHARE * (refused - bank.unexplained[n])
    # None of them has more than all have.
    if limits.jump_share * refused * whole / largest > limits.smallest_weight:
        _suspect_jumps(state, slots, reading, limits)


@compiled
def _suspect_jumps(
    state: Array, slots: npt.NDArray[np.int64], reading: Array, limits: Limits
) -> None:
    """Let estimates for which the tip was an outlier come back, displaced to where it was seen.

    Each takes the place of one that has ended, likeliest first, and weighs the share of its own
    that a jump has. If the needle was not displaced it will end soon; if it was, the next tips will
    be where it expects them, and the others will end.
    """
    while True:
        likeliest, most, free = -1, limits.smallest_weight, -1
        for s in slots:
            tile, h = state[s // LANES], s % LANES
            weight = limits.jump_share * tile[WEIGHT, h] * tile[OUTLIER, h]
            if weight > most:
                likeliest, most = s, weight
            if tile[WEIGHT, h] == 0.0:
                free = s
        if likeliest < 0 or free < 0:
            return
        state[likeliest // LANES, OUTLIER, likeliest % LANES] = 0.0
        tile, h = state[free // LANES], free % LANES
        for row in range(ROWS):
            tile[row, h] = state[likeliest // LANES, row, likeliest % LANES]
        tile[WEIGHT, h] = most
        for axis in range(3):
            tile[PLACE[E_TURN + axis, E_TURN + axis], h] += limits.jump_turn_variance
        _put_at_tip(tile, h, reading)


@compiled
def _put_at_tip(tile: Array, h: int, reading: Array) -> None:
    """Let an estimate know of the needle's place what a tip says, and no more."""
    # What the readings' directions undo: the tip is L times them, its covariance L D L^T.
    l10, l21 = -reading[ALONG + 3], -reading[ALONG + 7]
    l20 = l21 * l10 - reading[ALONG + 6]
    read = reading[READ : READ + 3]
    d = reading[BOUND : BOUND + 3] ** 2 / 3.0
    tile[X, h] = read[0]
    tile[X + 1, h] = l10 * read[0] + read[1]
    tile[X + 2, h] = l20 * read[0] + l21 * read[1] + read[2]
    for axis in range(3):
        tile[REMAINDER + axis, h] = 0.0
        for k in range(3, ERROR):
            tile[PLACE[axis, k], h] = 0.0
    tile[PLACE[0, 0], h] = d[0]
    tile[PLACE[0, 1], h], tile[PLACE[1, 1], h] = l10 * d[0], l10 * l10 * d[0] + d[1]
    tile[PLACE[0, 2], h], tile[PLACE[1, 2], h] = l20 * d[0], l20 * l10 * d[0] + l21 * d[1]
    tile[PLACE[2, 2], h] = l20 * l20 * d[0] + l21 * l21 * d[1] + d[2]
