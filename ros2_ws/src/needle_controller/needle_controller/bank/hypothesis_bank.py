"""Many needles, several Gaussian estimates of each: what is done to all of them; compiled.

Beside its estimates a needle has how likely each noise model is, and what became of its last tips.
Angles of base and tip count from the start.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from needle_common.compiled import compiled
from needle_controller.bank.estimate_tiles import (
    E_TURN,
    EVIDENCE,
    LANES,
    OUTLIER,
    PLACE,
    ROWS,
    WEIGHT,
    Tiles,
)
from needle_controller.bank.filter_settings import Drift, Limits
from needle_controller.bank.tip_motion import LARGEST_TURN, MOTION_ROWS, move
from needle_controller.bank.tip_update import FOUND, READING_ROWS, UPDATE_ROWS, take_tip
from needle_controller.model.arrays import Array

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
            _judge(bank, n, limits)


@compiled
def _judge(bank: Bank, n: int, limits: Limits) -> None:
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
        _suspect_jumps(state, slots, limits)


@compiled
def _suspect_jumps(state: Array, slots: npt.NDArray[np.int64], limits: Limits) -> None:
    """Let estimates for which the tip was an outlier come back, displaced nobody knows where.

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
            tile[PLACE[axis, axis], h] += limits.jump_variance
            tile[PLACE[E_TURN + axis, E_TURN + axis], h] += limits.jump_turn_variance
