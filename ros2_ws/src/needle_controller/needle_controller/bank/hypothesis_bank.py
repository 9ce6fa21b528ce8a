"""Many needles, several Gaussian estimates of each: what is done to all of them; compiled.

A needle's hypotheses that are still alive come first; `alive` says how many they are. What lies
behind them in their last block is calculated along and has no weight. Angles of base and tip count
from the start.
"""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from needle_common.compiled import compiled
from needle_controller.bank.hypothesis_lanes import (
    BEHIND_PLAY,
    KAPPA,
    LAG,
    LANES,
    PER_SIZE,
    PLAY,
    SIZE_CHANGE,
    SURPRISE,
    TIP_ANGLE,
    WEIGHT,
)
from needle_controller.bank.hypothesis_pruning import merge, prune
from needle_controller.bank.tip_motion import LARGEST_TURN, move
from needle_controller.bank.tip_update import squared_distance, take_bounded, take_gaussian
from needle_controller.model.arrays import Array

EVIDENCE_SHARE = 0.15
"""Of the newest tip in the running mean of the evidence."""


class Bank(NamedTuple):
    """The state of all estimates.

    Attributes
    ----------
    alive : ndarray of int, shape (N,)
        Hypotheses alive of each needle.
    state : ndarray, shape (N, blocks, BLOCK)
        The estimates, see `hypothesis_lanes`. The heaviest of a needle has weight 1.
    base : ndarray, shape (N,)
        Rotation of the base since the start [rad].
    """

    alive: npt.NDArray[np.int64]
    state: Array
    base: Array


class Limits(NamedTuple):
    """What the estimates are kept to, and when they end; see `FilterSettings`."""

    orientation_noise: float
    curvature_noise: float
    play_noise: float
    lag_noise: float
    smallest_curvature: float
    largest_curvature: float
    largest_play: float
    smallest_lag: float
    largest_lag: float
    smallest_weight: float
    merge_angle: float
    gate: float
    tips_until_reacceptance: int
    surprise: float
    longest_step: float


@compiled
def advance_bank(bank: Bank, length: Array, turn: Array, limits: Limits) -> None:
    """Move every estimate by what the base did.

    Parameters
    ----------
    bank : Bank, changed
        The estimates.
    length, turn : ndarray, shape (N,)
        Inserted length [m] and rotation of the base over it [rad].
    limits : Limits
        Process noise, and the longest step that is taken at once.
    """
    for n in range(bank.alive.size):
        parts = math.ceil(
            max(length[n] / limits.longest_step, abs(turn[n]) / LARGEST_TURN, 1.0) - 1e-9
        )
        step, part = length[n] / parts, turn[n] / parts
        for _ in range(parts):
            for b in range((bank.alive[n] + LANES - 1) // LANES):
                move(
                    bank.state[n, b],
                    bank.base[n],
                    part,
                    step,
                    limits.orientation_noise * step,
                    limits.curvature_noise * step,
                    limits.play_noise * step,
                    limits.lag_noise * step,
                )
            bank.base[n] += part


@compiled
def correct_bank(
    bank: Bank,
    tip: Array,
    noise: Array,
    bound: float,
    softness: float,
    limits: Limits,
    merging: bool,
    refused_in_row: npt.NDArray[np.int64],
    evidence: Array,
) -> None:
    """Take one measured tip of every needle.

    Parameters
    ----------
    bank : Bank, changed
        The estimates.
    tip : ndarray, shape (N, 3)
        The tips [m]; NaN where there is none.
    noise : ndarray, shape (N or 1, 3, 3)
        Their covariance [m^2], also for the gate.
    bound, softness : float
        The noise's bound [m] and its edges' variance [m^2]; bound 0: Gaussian noise instead.
    limits : Limits
        Gate, bounds of the estimates, pruning and merging.
    merging : bool
        Whether to look for hypotheses that have become the same.
    refused_in_row : ndarray of int, shape (N,), changed
        Tips refused since the last one taken.
    evidence : ndarray, shape (N,), changed
        Running mean of how well all hypotheses together explain the tips, as a log likelihood; a
        tip as good as its noise is 0.
    """
    for n in range(bank.alive.size):
        if not np.isfinite(tip[n, 0] + tip[n, 1] + tip[n, 2]):
            continue
        state = bank.state[n]
        spread = noise[min(n, noise.shape[0] - 1)]
        if refused_in_row[n] < limits.tips_until_reacceptance and not _believed(
            state, bank.alive[n], tip[n], spread, limits.gate
        ):
            refused_in_row[n] += 1
            continue
        refused_in_row[n] = 0
        before = _whole_weight(state, bank.alive[n])
        for b in range((bank.alive[n] + LANES - 1) // LANES):
            if bound > 0.0:
                take_bounded(state[b], tip[n], bound, softness, limits.surprise)
            else:
                take_gaussian(state[b], tip[n], spread)
            _keep_in_limits(state[b], limits)
        gained = 0.0
        if bound <= 0.0:
            gained = 1.5 - 0.5 * _weigh_by_distance(state, bank.alive[n])
        after = _whole_weight(state, bank.alive[n])
        evidence[n] += EVIDENCE_SHARE * (math.log(after / before) + gained - evidence[n])
        bank.alive[n] = prune(state, bank.alive[n], limits.smallest_weight)
        if bank.alive[n] > LANES and merging:
            bank.alive[n] = merge(state, bank.alive[n], limits.merge_angle)


@compiled
def _believed(state: Array, alive: int, tip: Array, spread: Array, gate: float) -> bool:
    """Return whether a tip is within the gate of any hypothesis."""
    for h in range(alive):
        if squared_distance(state[h // LANES], h % LANES, tip, spread) <= gate:
            return True
    return False


@compiled
def _whole_weight(state: Array, alive: int) -> float:
    total = 0.0
    for h in range(alive):
        total += state[h // LANES, WEIGHT + h % LANES]
    return total


@compiled
def _weigh_by_distance(state: Array, alive: int) -> float:
    """Multiply the weights by exp(-(d - d of the nearest)/2), and return that d."""
    nearest = np.inf
    for h in range(alive):
        nearest = min(nearest, state[h // LANES, SURPRISE + h % LANES])
    for h in range(alive):
        distance = state[h // LANES, SURPRISE + h % LANES]
        state[h // LANES, WEIGHT + h % LANES] *= math.exp(0.5 * (nearest - distance))
    return nearest


@compiled
def _keep_in_limits(block: Array, limits: Limits) -> None:
    """Bound the curvature; change the torsion's size, with which the tip has turned all along."""
    for h in range(LANES):
        block[KAPPA + h] = min(
            max(block[KAPPA + h], limits.smallest_curvature), limits.largest_curvature
        )
        change, tip = block[SIZE_CHANGE + h], block[TIP_ANGLE + h]
        lag, play, per_size = block[LAG + h], block[PLAY + h], block[PER_SIZE + h]
        has_lag = lag > 0.0
        new_lag = min(max(lag + change, limits.smallest_lag), limits.largest_lag)
        new_play = min(max(play + change, 0.0), limits.largest_play)
        tip += per_size * (new_lag - lag if has_lag else new_play - play)
        changed = change != 0.0
        block[TIP_ANGLE + h] = tip if changed else block[TIP_ANGLE + h]
        block[LAG + h] = new_lag if changed and has_lag else lag
        block[PLAY + h] = new_play if changed and not has_lag else play
        behind = block[BEHIND_PLAY + h]
        block[BEHIND_PLAY + h] = tip if changed and not has_lag else behind
