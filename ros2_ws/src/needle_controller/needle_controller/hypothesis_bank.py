"""Many needles, several Gaussian estimates of each: what is done to all of them; compiled.

A bank is structure of arrays, [needles, hypotheses, ...]. A needle's hypotheses that are still
alive come first; `alive` says how many they are. Angles of base and tip count from the start.
"""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from needle_common.compiled import compiled
from needle_controller.arrays import Array
from needle_controller.tip_motion import CURVATURE, ERROR, TORSION, move, propagate
from needle_controller.tip_update import bounded_update, gaussian_update, squared_distance
from needle_controller.torsion_model import turn_tip

PLAY, LAG, TIP_ANGLE, BEHIND_PLAY, PER_TORSION, KIND = range(6)
"""Columns of `Bank.torsion`."""
_SAME_LAG = 0.001
EVIDENCE_SHARE = 0.15
"""Of the newest tip in the running mean of the evidence."""


class Bank(NamedTuple):
    """The state of all estimates.

    Attributes
    ----------
    alive : ndarray of int, shape (N,)
        Hypotheses alive of each needle.
    position : ndarray, shape (N, H, 3)
        Tip in `target_plane` [m].
    rotation : ndarray, shape (N, H, 3, 3)
        Orientation of the tip.
    covariance : ndarray, shape (N, H, 8, 8)
        Covariance of the error as `tip_motion` orders it.
    curvature : ndarray, shape (N, H)
        kappa [1/m].
    torsion : ndarray, shape (N, H, 6)
        Play [rad], lag length [m], angles of the tip and of the shaft behind the play [rad],
        derivative of the tip's angle with respect to the torsion's size, number of the torsion
        hypothesis.
    log_weight : ndarray, shape (N, H)
        Log weights, the needle's largest being 0.
    base : ndarray, shape (N,)
        Rotation of the base since the start [rad].
    """

    alive: npt.NDArray[np.int64]
    position: Array
    rotation: Array
    covariance: Array
    curvature: Array
    torsion: Array
    log_weight: Array
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
    prune_below: float
    merge_angle: float
    gate: float
    tips_until_reacceptance: int
    surprise: float


@compiled
def advance_bank(
    bank: Bank, length: Array, turn: Array, limits: Limits, with_covariance: bool
) -> None:
    """Move every estimate by what the base did.

    Parameters
    ----------
    bank : Bank, changed
        The estimates.
    length, turn : ndarray, shape (N,)
        Inserted length [m] and rotation of the base over it [rad].
    limits : Limits
        Process noise.
    with_covariance : bool
        Whether the covariances move too.
    """
    sensitivity = np.empty(9)
    for n in range(bank.alive.size):
        step, base = length[n], bank.base[n]
        for h in range(bank.alive[n]):
            torsion = bank.torsion[n, h]
            tip, behind, per_torsion = turn_tip(
                torsion[TIP_ANGLE],
                torsion[BEHIND_PLAY],
                torsion[PER_TORSION],
                base,
                turn[n],
                step,
                torsion[PLAY],
                torsion[LAG],
            )
            move(
                bank.position[n, h],
                bank.rotation[n, h],
                bank.curvature[n, h],
                step,
                tip - torsion[TIP_ANGLE],
                sensitivity,
            )
            if with_covariance:
                propagate(
                    bank.covariance[n, h],
                    sensitivity,
                    step,
                    per_torsion - torsion[PER_TORSION],
                    limits.orientation_noise * step,
                    limits.curvature_noise * step,
                )
                covariance = bank.covariance[n, h]
                if covariance[TORSION, TORSION] > 0.0:
                    noise = limits.lag_noise if torsion[LAG] > 0.0 else limits.play_noise
                    covariance[TORSION, TORSION] += noise * step
            torsion[TIP_ANGLE] = tip
            torsion[BEHIND_PLAY] = behind
            torsion[PER_TORSION] = per_torsion
        bank.base[n] = base + turn[n]


@compiled
def correct_bank(
    bank: Bank,
    tip: Array,
    noise: Array,
    bound: float,
    softness: float,
    limits: Limits,
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
    refused_in_row : ndarray of int, shape (N,), changed
        Tips refused since the last one taken.
    evidence : ndarray, shape (N,), changed
        Running mean of how well all hypotheses together explain the tips, as a log likelihood.
    """
    change, gain = np.empty(ERROR), np.empty((ERROR, 3))
    rolls = np.empty(bank.position.shape[1])
    for n in range(bank.alive.size):
        if not np.isfinite(tip[n, 0] + tip[n, 1] + tip[n, 2]):
            continue
        spread = noise[min(n, noise.shape[0] - 1)]
        nearest = np.inf
        for h in range(bank.alive[n]):
            distance = squared_distance(bank.position[n, h], bank.covariance[n, h], tip[n], spread)
            nearest = min(nearest, distance)
        if nearest > limits.gate and refused_in_row[n] < limits.tips_until_reacceptance:
            refused_in_row[n] += 1
            continue
        refused_in_row[n] = 0
        # A tip as good as its noise is evidence 0.
        offset = 0.0 if bound > 0.0 else 1.5 + 0.5 * math.log(_determinant(spread))
        before = after = 0.0
        for h in range(bank.alive[n]):
            position, rotation = bank.position[n, h], bank.rotation[n, h]
            if bound > 0.0:
                likelihood = bounded_update(
                    position,
                    rotation,
                    bank.covariance[n, h],
                    tip[n],
                    bound,
                    softness,
                    limits.surprise,
                    change,
                )
            else:
                likelihood = gaussian_update(
                    position, rotation, bank.covariance[n, h], tip[n], spread, change, gain
                )
                likelihood += offset
            before += math.exp(bank.log_weight[n, h])
            bank.log_weight[n, h] += likelihood
            after += math.exp(bank.log_weight[n, h])
            if likelihood == 0.0:
                continue
            curvature = bank.curvature[n, h] + change[CURVATURE]
            bank.curvature[n, h] = min(
                max(curvature, limits.smallest_curvature), limits.largest_curvature
            )
            _resize_torsion(bank.torsion[n, h], change[TORSION], limits)
        evidence[n] += EVIDENCE_SHARE * (math.log(after / before) - evidence[n])
        _prune(bank, n, limits.prune_below)
        if bank.alive[n] > 1 and limits.merge_angle > 0.0:
            _merge(bank, n, limits.merge_angle, rolls)


@compiled
def _determinant(m: Array) -> float:
    first = m[0, 0] * (m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1])
    second = m[0, 1] * (m[1, 0] * m[2, 2] - m[1, 2] * m[2, 0])
    third = m[0, 2] * (m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0])
    return float(first - second + third)


@compiled
def _resize_torsion(torsion: Array, change: float, limits: Limits) -> None:
    """Change the torsion's size; the tip has turned accordingly all along."""
    if change == 0.0:
        return
    if torsion[LAG] > 0.0:
        size = min(max(torsion[LAG] + change, limits.smallest_lag), limits.largest_lag)
        torsion[TIP_ANGLE] += torsion[PER_TORSION] * (size - torsion[LAG])
        torsion[LAG] = size
    else:
        size = min(max(torsion[PLAY] + change, 0.0), limits.largest_play)
        torsion[TIP_ANGLE] += torsion[PER_TORSION] * (size - torsion[PLAY])
        torsion[BEHIND_PLAY] = torsion[TIP_ANGLE]
        torsion[PLAY] = size


@compiled
def _prune(bank: Bank, n: int, prune_below: float) -> None:
    """End hypotheses that became unlikely; make the largest log weight 0."""
    weight = bank.log_weight[n]
    largest = -np.inf
    for h in range(bank.alive[n]):
        largest = max(largest, weight[h])
    h = 0
    while h < bank.alive[n]:
        weight[h] -= largest
        if weight[h] < prune_below:
            _remove(bank, n, h)
        else:
            h += 1


@compiled
def _merge(bank: Bank, n: int, angle: float, rolls: Array) -> None:
    """Join hypotheses of the same torsion that have become the same: the heavier one stays."""
    for h in range(bank.alive[n]):
        rolls[h] = math.atan2(-bank.rotation[n, h, 0, 1], bank.rotation[n, h, 0, 0])
    first = 0
    while first < bank.alive[n]:
        second = first + 1
        while second < bank.alive[n]:
            if bank.torsion[n, first, KIND] == bank.torsion[n, second, KIND] and _same(
                bank, n, first, second, abs(rolls[first] - rolls[second]), angle
            ):
                heavy, light = bank.log_weight[n, first], bank.log_weight[n, second]
                if light > heavy:
                    _copy(bank, n, second, first)
                    rolls[first] = rolls[second]
                    heavy, light = light, heavy
                bank.log_weight[n, first] = heavy + math.log1p(math.exp(light - heavy))
                rolls[second] = rolls[bank.alive[n] - 1]
                _remove(bank, n, second)
            else:
                second += 1
        first += 1


@compiled
def _same(bank: Bank, n: int, first: int, second: int, roll: float, angle: float) -> bool:
    """Return whether two hypotheses are one: rolls, pitches and sizes of the torsion are near."""
    a, b = bank.torsion[n, first], bank.torsion[n, second]
    pitch = abs(bank.rotation[n, first, 0, 2] - bank.rotation[n, second, 0, 2])
    return (
        min(roll, 2.0 * math.pi - roll) < angle
        and pitch < 0.25 * angle
        and abs(a[PLAY] - b[PLAY]) < 0.5 * angle
        and abs(a[LAG] - b[LAG]) < _SAME_LAG
    )


@compiled
def _remove(bank: Bank, n: int, h: int) -> None:
    """End a hypothesis: the last one takes its place, with the weight as it is there."""
    last = bank.alive[n] - 1
    if h != last:
        _copy(bank, n, last, h)
    bank.alive[n] = last


@compiled
def _copy(bank: Bank, n: int, source: int, target: int) -> None:
    for i in range(3):
        bank.position[n, target, i] = bank.position[n, source, i]
        for j in range(3):
            bank.rotation[n, target, i, j] = bank.rotation[n, source, i, j]
    for i in range(ERROR):
        for j in range(ERROR):
            bank.covariance[n, target, i, j] = bank.covariance[n, source, i, j]
    for i in range(6):
        bank.torsion[n, target, i] = bank.torsion[n, source, i]
    bank.curvature[n, target] = bank.curvature[n, source]
    bank.log_weight[n, target] = bank.log_weight[n, source]
