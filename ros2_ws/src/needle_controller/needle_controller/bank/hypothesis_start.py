"""First estimates of a bank: every torsion hypothesis with every roll, at the first tip."""

from __future__ import annotations

import numpy as np

from needle_controller.bank.estimate_tiles import (
    E_KAPPA,
    E_SCALE,
    E_SIZE,
    E_TURN,
    KAPPA,
    KIND,
    LAG,
    NOISE,
    NOISES,
    PLACE,
    PLAY,
    ROWS,
    SCALE,
    SHAPE,
    WEIGHT,
    R,
    X,
    repeated,
    set_rows,
    tiles_of,
)
from needle_controller.bank.filter_settings import FilterSettings
from needle_controller.bank.hypothesis_bank import Bank
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import rotation_from_angles

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
    every = [
        (kind, torsion, roll, noise)
        for noise in settings.noise_hypotheses
        for kind, torsion in enumerate(settings.torsion_hypotheses)
        for roll in settings.roll_hypotheses
    ]
    # One that has ended, for a jump.
    every.append(every[0])
    numbers = np.zeros((len(every), ROWS))
    weights = np.array([t.weight * roll.weight * noise.weight for _, t, roll, noise in every])
    numbers[:-1, WEIGHT] = weights[:-1] / np.max(weights[:-1])
    numbers[:, KIND] = [kind for kind, _, _, _ in every]
    numbers[:, SHAPE] = [noise.shape for _, _, _, noise in every]
    for m in range(NOISES):
        for row in range(NOISE + m, NOISE + 3 * NOISES, NOISES):
            numbers[:, row] = [sum(noise.shares[m : m + 1]) for _, _, _, noise in every]
    numbers[:, KAPPA], numbers[:, SCALE] = settings.curvature, 1.0
    numbers[:, PLAY] = [torsion.play for _, torsion, _, _ in every]
    numbers[:, LAG] = [torsion.lag_length for _, torsion, _, _ in every]
    curvature_std = settings.curvature_spread * settings.curvature
    numbers[:, PLACE[E_KAPPA, E_KAPPA]] = curvature_std**2
    numbers[:, PLACE[E_SIZE, E_SIZE]] = [torsion.size_std**2 for _, torsion, _, _ in every]
    numbers[:, PLACE[E_SCALE, E_SCALE]] = settings.scale_spread**2
    # What each needle has of its own.
    needles = len(tip)
    tiles = repeated(tiles_of(numbers, np.array([len(every)])), needles)
    n, k = np.divmod(np.arange(tiles.first[-1]), len(every))
    found = np.all(np.isfinite(tip), axis=-1)
    set_rows(tiles, X, np.where(found[:, None], tip, 0.0)[n])
    rolls = rotation_from_angles([[0.0, 0.0, roll.roll] for _, _, roll, _ in every])
    set_rows(tiles, R, (rotation[:, None] @ rolls).reshape(-1, 9))
    position = np.where(found, settings.believed_bound**2 / 3.0, UNKNOWN_POSITION_STD**2)
    # About the heading as uncertain as the roll, else as pitch and yaw.
    angle = settings.initial_angle_std**2
    more = np.array([roll.std**2 - angle for _, _, roll, _ in every])
    for a in range(3):
        set_rows(tiles, PLACE[a, a], position[n, None])
        for b in range(a + 1):
            along_heading = more[k] * (rotation[:, a, 2] * rotation[:, b, 2])[n]
            turn = along_heading + (angle if a == b else 0.0)
            set_rows(tiles, PLACE[E_TURN + a, E_TURN + b], turn[:, None])
    return Bank(
        tiles,
        base=np.zeros(needles),
        refused=np.zeros(needles),
        unexplained=np.zeros(needles),
    )
