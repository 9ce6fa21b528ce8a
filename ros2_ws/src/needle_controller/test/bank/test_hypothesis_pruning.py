"""Which hypotheses are the same, and what is made of two of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_controller.bank.estimate_tiles import (
    ERROR,
    KAPPA,
    KIND,
    NOISE,
    PAIRS,
    PLAY,
    ROWS,
    SCALE,
    SHAPE,
    TIP_ANGLE,
    WEIGHT,
    P,
    R,
    Tiles,
    X,
    covariances,
    lower_half,
    rows,
    tiles_of,
)
from needle_controller.bank.hypothesis_pruning import merge
from needle_controller.model.arrays import Array

ANGLE = 0.35


def numbers(rolls: Array) -> Array:
    """Hypotheses of given rolls."""
    written = np.zeros((len(rolls), ROWS))
    turned = Rotation.from_rotvec(np.outer(rolls, [0.0, 0.0, 1.0])).as_matrix()
    written[:, R : R + 9] = turned.reshape(-1, 9)
    written[:, P : P + PAIRS] = lower_half(np.eye(ERROR) * 1e-4)
    written[:, WEIGHT] = 1.0
    return written


def merged(written: Array, counts: list[int] | None = None) -> Tiles:
    tiles = tiles_of(written, np.array(counts or [len(written)]))
    merge(tiles, ANGLE)
    return tiles


def test_only_what_is_the_same_is_joined() -> None:
    written = numbers(np.array([0.0, 0.2, 1.0, 0.1, 3.1, -3.1]))
    written[3, KIND] = 1.0
    # 0 and 0.2; 3.1 and -3.1, across the border; 0.1 is of another torsion.
    weights = rows(merged(written), WEIGHT, 1)[:, 0]
    np.testing.assert_array_equal(weights, [2.0, 0.0, 1.0, 1.0, 2.0, 0.0])


@pytest.mark.parametrize(("row", "other"), [(PLAY, ANGLE), (SHAPE, 1.0), (X, 0.02)])
def test_what_differs_stays_apart(row: int, other: float) -> None:
    written = numbers(np.array([0.0, 0.1]))
    written[1, row] = other
    np.testing.assert_array_equal(rows(merged(written), WEIGHT, 1), 1.0)


def test_another_needles_is_another() -> None:
    np.testing.assert_array_equal(rows(merged(numbers(np.zeros(2)), [1, 1]), WEIGHT, 1), 1.0)


def test_the_joined_estimate_has_the_mixtures_moments() -> None:
    """Against samples of both Gaussians together."""
    rng = np.random.default_rng(5)
    factor = rng.normal(size=(2, ERROR, ERROR)) * 0.02
    both = factor @ np.swapaxes(factor, -1, -2)
    difference = np.array([0.03, -0.02, 0.01, 0.03, -0.05, 0.1, 0.04, 0.05, 0.02])
    written = numbers(np.zeros(2))
    written[:, P : P + PAIRS] = lower_half(both)
    written[1, X : X + 3] = difference[:3]
    written[1, R : R + 9] = Rotation.from_rotvec(difference[3:6]).as_matrix().reshape(9)
    written[1, [KAPPA, PLAY, SCALE]] = difference[6:]
    written[:, WEIGHT], written[:, TIP_ANGLE], written[:, NOISE] = [1, 3], [1, 2], [0.2, 0.6]
    tiles = merged(written)
    samples = np.concatenate(
        [
            rng.multivariate_normal(np.zeros(ERROR), both[0], 100_000),
            rng.multivariate_normal(difference, both[1], 300_000),
        ]
    )
    mean, wanted = samples.mean(axis=0), np.cov(samples.T)
    deviation = np.sqrt(np.diag(wanted))
    joined = rows(tiles, 0, ROWS)[0]
    turn = Rotation.from_matrix(joined[R : R + 9].reshape(3, 3)).as_rotvec()
    found = np.concatenate([joined[X : X + 3], turn, joined[[KAPPA, PLAY, SCALE]]])
    np.testing.assert_allclose(found / deviation, mean / deviation, atol=0.01)
    scale = np.outer(deviation, deviation)
    np.testing.assert_allclose(covariances(tiles)[0] / scale, wanted / scale, atol=0.02)
    assert joined[TIP_ANGLE] == 1.75
    assert joined[NOISE] == pytest.approx(0.5)
    np.testing.assert_array_equal(rows(tiles, WEIGHT, 1)[:, 0], [4.0, 0.0])
