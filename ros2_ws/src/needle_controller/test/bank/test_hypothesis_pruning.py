"""Which hypotheses end, and what is made of two that have become the same."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from needle_controller.bank.hypothesis_lanes import (
    BLOCK,
    ERROR,
    KAPPA,
    KIND,
    LANES,
    PLAY,
    R00,
    TIP_ANGLE,
    WEIGHT,
    X,
    covariances,
    rows,
    set_covariances,
    set_rows,
)
from needle_controller.bank.hypothesis_pruning import merge, prune
from needle_controller.model.arrays import Array

COUNT = 2 * LANES
ANGLE = 0.35


def bank(weights: Array, rolls: Array) -> Array:
    """A needle's hypotheses of given weights and rolls, told apart by their x."""
    state = np.zeros((1, 2, BLOCK))
    count = len(weights)
    turned = np.zeros((1, COUNT, 9))
    turned[0, :count] = (
        Rotation.from_rotvec(np.outer(rolls, [0.0, 0.0, 1.0])).as_matrix().reshape(count, 9)
    )
    set_rows(state, R00, turned)
    set_rows(state, X, np.arange(3.0 * COUNT).reshape(1, COUNT, 3) * 1e-5)
    set_covariances(state, np.broadcast_to(np.eye(ERROR) * 1e-4, (1, COUNT, ERROR, ERROR)))
    filled = np.zeros((1, COUNT, 1))
    filled[0, :count, 0] = weights
    set_rows(state, WEIGHT, filled)
    return state


def test_the_unlikely_end_and_the_heaviest_weighs_1() -> None:
    weights = np.array([0.2, 1e-4, 0.5, 1e-3, 2.0, 1e-4, 0.7, 0.3, 1e-5, 0.4])
    state = bank(weights, np.zeros(10))
    before = dict(zip(weights / 2.0, rows(state, X, 1)[0, :10, 0], strict=True))
    alive = prune(state[0], 10, 0.002)
    assert alive == 6
    left = rows(state, WEIGHT, 1)[0, :, 0]
    assert sorted(left[:alive]) == sorted(w for w in weights / 2.0 if w >= 0.002)
    np.testing.assert_array_equal(left[alive:], 0.0)
    # Each one's numbers have come along.
    assert [before[w] for w in left[:alive]] == rows(state, X, 1)[0, :alive, 0].tolist()


def test_only_what_is_the_same_is_joined() -> None:
    rolls = np.array([0.0, 0.2, 1.0, 0.1, 3.1, -3.1])
    state = bank(np.ones(6), rolls)
    kinds = np.zeros((1, COUNT, 1))
    kinds[0, 3] = 1.0
    set_rows(state, KIND, kinds)
    # 0 and 0.2; 3.1 and -3.1, across the border; 0.1 is of another torsion.
    assert merge(state[0], 6, ANGLE) == 4
    weights = rows(state, WEIGHT, 1)[0, :, 0]
    assert sorted(weights[:4]) == [1.0, 1.0, 2.0, 2.0]
    assert np.sum(weights) == 6.0
    plays = np.zeros((1, COUNT, 1))
    plays[0, 1] = ANGLE
    state = bank(np.ones(2), np.array([0.0, 0.1]))
    set_rows(state, PLAY, plays)
    assert merge(state[0], 2, ANGLE) == 2


def test_the_joined_estimate_has_the_mixtures_moments() -> None:
    """Against samples of both Gaussians together."""
    rng = np.random.default_rng(5)
    state = bank(np.array([1.0, 3.0]), np.array([0.0, 0.0]))
    factor = rng.normal(size=(2, ERROR, ERROR)) * 0.02
    both = np.zeros((1, COUNT, ERROR, ERROR))
    both[0, :2] = factor @ np.swapaxes(factor, -1, -2)
    set_covariances(state, both)
    difference = np.array([0.03, -0.02, 0.01, 0.03, -0.05, 0.1, 0.04, 0.05])
    apart = state.copy()
    apart[0, 0, [X + 1, X + LANES + 1, X + 2 * LANES + 1]] = (
        apart[0, 0, [X, X + LANES, X + 2 * LANES]] + difference[:3]
    )
    turned = rows(apart, R00, 9)
    turned[0, 1] = Rotation.from_rotvec(difference[3:6]).as_matrix().reshape(9)
    set_rows(apart, R00, turned)
    apart[0, 0, KAPPA + 1], apart[0, 0, PLAY + 1] = difference[6], difference[7]
    apart[0, 0, TIP_ANGLE], apart[0, 0, TIP_ANGLE + 1] = 1.0, 2.0
    first = apart[0, 0, [X, X + LANES, X + 2 * LANES]].copy()
    samples = np.concatenate(
        [
            rng.multivariate_normal(np.zeros(ERROR), both[0, 0], 100_000),
            rng.multivariate_normal(difference, both[0, 1], 300_000),
        ]
    )
    assert merge(apart[0], 2, ANGLE) == 1
    mean, wanted = samples.mean(axis=0), np.cov(samples.T)
    deviation = np.sqrt(np.diag(wanted))
    joined = apart[0, 0]
    found = np.concatenate(
        [
            joined[[X, X + LANES, X + 2 * LANES]] - first,
            Rotation.from_matrix(rows(apart, R00, 9)[0, 0].reshape(3, 3)).as_rotvec(),
            joined[[KAPPA, PLAY]],
        ]
    )
    np.testing.assert_allclose(found / deviation, mean / deviation, atol=0.01)
    scale = np.outer(deviation, deviation)
    np.testing.assert_allclose(covariances(apart)[0, 0] / scale, wanted / scale, atol=0.02)
    assert joined[TIP_ANGLE] == 1.75
    assert joined[WEIGHT] == 4.0
