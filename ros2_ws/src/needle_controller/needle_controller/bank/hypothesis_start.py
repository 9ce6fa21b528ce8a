"""What a bank begins with: every torsion hypothesis with every roll, at the first tip."""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import numpy as np
import numpy.typing as npt

from needle_common.compiled import compiled
from needle_controller.bank.filter_settings import FilterSettings
from needle_controller.bank.hypothesis_bank import Bank
from needle_controller.bank.hypothesis_lanes import (
    BEHIND_PLAY,
    BLOCK,
    KAPPA,
    KIND,
    LAG,
    LANES,
    P00,
    P11,
    P22,
    P33,
    P43,
    P44,
    P53,
    P54,
    P55,
    P66,
    P77,
    PLAY,
    R00,
    TIP_ANGLE,
    WEIGHT,
    X,
    Y,
    Z,
    blocks_for,
    rows,
    set_rows,
)
from needle_controller.model.arrays import Array

UNKNOWN_POSITION_STD = 0.02
"""Of a needle that starts without a tip [m]."""


def start_bank(settings: FilterSettings, tip: Array, rotation: Array) -> Bank:
    """Return a bank with every hypothesis.

    Parameters
    ----------
    settings : FilterSettings
        The hypotheses, and how well all else is known.
    tip : ndarray, shape (N, 3)
        The measured tips [m]; NaN where there is none.
    rotation : ndarray, shape (N, 3, 3)
        The orientations that a roll hypothesis of 0 has.
    """
    count = len(settings.torsion_hypotheses) * len(settings.roll_hypotheses)
    found = np.all(np.isfinite(tip), axis=-1)
    bound = settings.believed_bound
    state = np.repeat(_template(settings), len(tip), axis=0)
    _place(
        state,
        np.where(found[:, None], tip, 0.0),
        np.where(found, bound**2 / 3.0, UNKNOWN_POSITION_STD**2),
        np.ascontiguousarray(rotation),
        np.array([roll.roll for roll in settings.roll_hypotheses]),
        np.array([roll.std**2 for roll in settings.roll_hypotheses]),
        settings.initial_angle_std**2,
    )
    return Bank(np.full(len(tip), count, dtype=np.int64), state, np.zeros(len(tip)))


def start_over(bank: Bank, needles: npt.NDArray[np.int64], settings: FilterSettings) -> Bank:
    """Return a bank in which some needles have every hypothesis again, from where they were seen.

    Nothing is known of their roll any more, not even what the base says of it.
    """
    weights = rows(bank.state, WEIGHT, 1)[needles, :, 0]
    alive = np.arange(weights.shape[1]) < bank.alive[needles, None]
    best = np.argmax(np.where(alive, weights, -1.0), axis=1)
    rotation = rows(bank.state, R00, 9)[needles, best].reshape(-1, 3, 3)
    fresh = start_bank(settings, rows(bank.state, X, 3)[needles, best], rotation)
    for row in (TIP_ANGLE, BEHIND_PLAY):
        fresh.state[:, :, row : row + LANES] = bank.base[needles, None, None]
    even = _filled(
        [t.weight for t in settings.torsion_hypotheses for _ in settings.roll_hypotheses]
    )
    set_rows(fresh.state, WEIGHT, np.broadcast_to(even[:, None], (len(needles), len(even), 1)))
    more = fresh.state.shape[1] - bank.state.shape[1]
    if more > 0:
        bank = bank._replace(state=np.pad(bank.state, [(0, 0), (0, more), (0, 0)]))
    bank.alive[needles] = fresh.alive
    bank.state[needles, : fresh.state.shape[1]] = fresh.state
    return bank


def _template(settings: FilterSettings) -> Array:
    """Return the blocks of one needle, shape (1, blocks, BLOCK), less what depends on the needle.

    What fills the last block is like its last hypothesis, but has no weight.
    """
    torsions, rolls = settings.torsion_hypotheses, settings.roll_hypotheses
    pairs = [(k, t, r) for k, t in enumerate(torsions) for r in rolls]
    template = np.zeros((1, blocks_for(len(pairs)), BLOCK))
    weights = _filled([t.weight * r.weight for _, t, r in pairs])
    pairs += pairs[-1:] * (len(weights) - len(pairs))
    for row, values in {
        P66: [(settings.curvature_spread * settings.curvature) ** 2] * len(pairs),
        P77: [t.size_std**2 for _, t, _ in pairs],
        KAPPA: [settings.curvature] * len(pairs),
        PLAY: [t.play for _, t, _ in pairs],
        LAG: [t.lag_length for _, t, _ in pairs],
        KIND: [float(k) for k, _, _ in pairs],
        WEIGHT: weights,
    }.items():
        set_rows(template, row, np.asarray(values)[None, :, None])
    return template


def _filled(weights: list[float]) -> Array:
    """Return weights with the largest 1, filled up with 0 to whole blocks."""
    filled = np.zeros(blocks_for(len(weights)) * LANES)
    filled[: len(weights)] = np.array(weights) / np.max(weights)
    return filled


@compiled
def _place(
    state: Array,
    tip: Array,
    position_variance: Array,
    rotation: Array,
    rolls: Array,
    roll_variances: Array,
    angle_variance: float,
) -> None:
    """Write every hypothesis's position and orientation, and their covariance."""
    cosines, sines = np.cos(rolls), np.sin(rolls)
    for n in range(state.shape[0]):
        r = rotation[n]
        for h in range(state.shape[1] * LANES):
            p, i, k = state[n, h // LANES], h % LANES, h % rolls.size
            p[X + i], p[Y + i], p[Z + i] = tip[n, 0], tip[n, 1], tip[n, 2]
            for j in range(3):
                row = R00 + 3 * j * LANES + i
                p[row] = r[j, 0] * cosines[k] + r[j, 1] * sines[k]
                p[row + LANES] = r[j, 1] * cosines[k] - r[j, 0] * sines[k]
                p[row + 2 * LANES] = r[j, 2]
            p[P00 + i] = p[P11 + i] = p[P22 + i] = position_variance[n]
            # About the heading as uncertain as the roll, else as pitch and yaw.
            more = roll_variances[k] - angle_variance
            p[P33 + i] = angle_variance + more * r[0, 2] * r[0, 2]
            p[P43 + i] = more * r[1, 2] * r[0, 2]
            p[P44 + i] = angle_variance + more * r[1, 2] * r[1, 2]
            p[P53 + i] = more * r[2, 2] * r[0, 2]
            p[P54 + i] = more * r[2, 2] * r[1, 2]
            p[P55 + i] = angle_variance + more * r[2, 2] * r[2, 2]
