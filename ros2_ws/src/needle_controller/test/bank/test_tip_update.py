"""Updates by one tip: bounded and Gaussian noise, eight estimates at a time."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from needle_controller.bank.hypothesis_lanes import (
    BLOCK,
    KAPPA,
    LANES,
    R00,
    SIZE_CHANGE,
    SURPRISE,
    WEIGHT,
    X,
    covariances,
    rows,
    set_covariances,
    set_rows,
)
from needle_controller.bank.tip_update import (
    SMALLEST_VARIANCE,
    rotate,
    squared_distance,
    take_bounded,
    take_gaussian,
)
from needle_controller.model.arrays import Array

SCALES = np.array([3e-4, 3e-4, 3e-4, 0.1, 0.1, 0.3, 1.0, 0.1])
SEVERAL = 8


def estimates(covariance: Array | None = None, seed: int = 3) -> Array:
    """Eight estimates about (1, 2, 3) cm as a bank of one needle; by default none like another."""
    rng = np.random.default_rng(seed)
    state = np.zeros((1, 1, BLOCK))
    set_rows(state, X, np.array([0.01, 0.02, 0.03]) + rng.normal(0.0, 1e-3, (1, LANES, 3)))
    set_rows(state, R00, Rotation.random(LANES, random_state=seed).as_matrix().reshape(1, LANES, 9))
    if covariance is None:
        factor = rng.normal(size=(1, LANES, 8, 8)) * SCALES[:, None]
        set_covariances(state, factor @ np.swapaxes(factor, -1, -2))
    else:
        set_covariances(state, np.broadcast_to(covariance, (1, LANES, 8, 8)))
    state[0, 0, KAPPA : KAPPA + LANES] = 8.0
    state[0, 0, WEIGHT : WEIGHT + LANES] = 1.0
    return state


def positions(state: Array) -> Array:
    return np.asarray(rows(state, X, 3)[0])


def orientations(state: Array) -> Array:
    return np.asarray(rows(state, R00, 9)[0].reshape(LANES, 3, 3))


def bounded(state: Array, tip: Array, softness: float = 0.0, surprise: float = 0.05) -> Array:
    """Return what `take_bounded` makes of a bank, with a bound of 1 mm."""
    state = state.copy()
    take_bounded(state[0, 0], tip, 0.001, softness, surprise)
    return state


def changes(before: Array, after: Array) -> Array:
    """What was added to the error's eight coordinates, (LANES, 8)."""
    turned = orientations(after) @ np.swapaxes(orientations(before), -1, -2)
    return np.concatenate(
        [
            positions(after) - positions(before),
            Rotation.from_matrix(turned).as_rotvec(),
            (after - before)[0, 0, KAPPA : KAPPA + LANES, None],
            after[0, 0, SIZE_CHANGE : SIZE_CHANGE + LANES, None],
        ],
        axis=1,
    )


def test_bounded_update_has_the_posteriors_moments() -> None:
    """Against samples of the prior, those in the box kept; one coordinate measured."""
    rng = np.random.default_rng(4)
    covariance = np.zeros((8, 8))
    used = [0, 4, 6, 7]
    covariance[np.ix_(used, used)] = [
        [2.5e-7, 3e-5, 2e-4, 1e-5],
        [3e-5, 0.01, 0.02, 1e-3],
        [2e-4, 0.02, 1.0, 0.0],
        [1e-5, 1e-3, 0.0, 0.01],
    ]
    covariance[1, 1] = covariance[2, 2] = 1e-12
    samples = rng.multivariate_normal(np.zeros(8), covariance, 400_000)
    before = estimates(covariance)
    offset = np.array([0.0012, 0.0, 0.0])
    tip = positions(before)[2] + offset
    kept = samples[np.abs(samples[:, 0] - offset[0]) <= 0.001]
    after = bounded(before, tip, surprise=1e-9)
    assert after[0, 0, WEIGHT + 2] == pytest.approx(len(kept) / len(samples), rel=0.02)
    deviation = np.sqrt(np.diag(np.cov(kept.T)))
    np.testing.assert_allclose(
        changes(before, after)[2, used] / deviation[used],
        kept.mean(axis=0)[used] / deviation[used],
        atol=0.02,
    )
    scale = np.outer(deviation, deviation)[np.ix_(used, used)]
    np.testing.assert_allclose(
        covariances(after)[0, 2][np.ix_(used, used)] / scale,
        np.cov(kept.T)[np.ix_(used, used)] / scale,
        atol=0.02,
    )


def test_a_tip_that_surprises_nobody_changes_nothing() -> None:
    before = estimates(np.diag((SCALES * 0.1) ** 2))
    set_rows(before, X, np.broadcast_to([0.01, 0.02, 0.03], (1, LANES, 3)))
    after = bounded(before, np.array([0.0101, 0.0199, 0.03]))
    np.testing.assert_array_equal(after, before)


@pytest.mark.parametrize("offset", [0.003, -0.003])
def test_a_prior_outside_the_box_is_taken_to_its_edge(offset: float) -> None:
    before = estimates(np.eye(8) * 1e-10)
    set_rows(before, X, np.zeros((1, LANES, 3)))
    after = bounded(before, np.array([offset, 0.0, 0.0]))
    np.testing.assert_allclose(positions(after)[:, 0], offset - np.copysign(0.001, offset))
    variance = covariances(after)[0, :, 0, 0]
    assert np.all((variance > 0.0) & (variance < 1e-10))


def test_no_single_tip_is_proof() -> None:
    """However far off: each coordinate costs at most the factor `surprise`."""
    before = estimates(np.eye(8) * 1e-10)
    set_rows(before, X, np.zeros((1, LANES, 3)))
    weights = [
        bounded(before, np.array([offset, 0.0, 0.0]))[0, 0, WEIGHT]
        for offset in (0.00102, 0.0011, 0.005)
    ]
    assert weights[0] > weights[1] >= weights[2] == pytest.approx(0.05)


NOISE = np.array([[4e-7, 1e-7, 0.0], [1e-7, 9e-7, -2e-7], [0.0, -2e-7, 2.5e-7]])


def test_gaussian_update_is_kalmans() -> None:
    before = estimates()
    tip = np.array([0.0105, 0.0193, 0.031])
    after = before.copy()
    take_gaussian(after[0, 0], tip, NOISE)
    measured = np.eye(8)[:3]
    found = changes(before, after)
    for h in range(SEVERAL):
        covariance, innovation = covariances(before)[0, h], tip - positions(before)[h]
        spread = measured @ covariance @ measured.T + NOISE
        gain = covariance @ measured.T @ np.linalg.inv(spread)
        np.testing.assert_allclose(found[h], gain @ innovation, rtol=1e-6, atol=1e-9)
        keep = np.eye(8) - gain @ measured
        wanted = keep @ covariance @ keep.T + gain @ NOISE @ gain.T
        scale = np.outer(np.sqrt(np.diag(wanted)), np.sqrt(np.diag(wanted)))
        np.testing.assert_allclose(covariances(after)[0, h] / scale, wanted / scale, atol=1e-6)
        # Weight and distance together are the density, relative to that at the noise's middle.
        density = multivariate_normal(positions(before)[h], spread).pdf(tip)
        at_middle = multivariate_normal(np.zeros(3), NOISE).pdf(np.zeros(3))
        likelihood = after[0, 0, WEIGHT + h] * np.exp(-0.5 * after[0, 0, SURPRISE + h])
        assert likelihood == pytest.approx(density / at_middle, rel=1e-6)


def test_an_exact_tip_is_taken() -> None:
    after = estimates()
    take_gaussian(after[0, 0], np.array([0.01, 0.02, 0.03]), np.zeros((3, 3)))
    assert np.all(np.isfinite(after))
    np.testing.assert_allclose(positions(after), np.tile([0.01, 0.02, 0.03], (LANES, 1)), atol=1e-8)
    assert SMALLEST_VARIANCE < 1e-12


def test_squared_distance_adds_the_coordinates() -> None:
    state = estimates(np.diag([1.0, 2.0, 3.0, 0, 0, 0, 0, 0]))
    tip = positions(state)[5] + 2.0
    distance = squared_distance(state[0, 0], 5, tip, np.eye(3))
    assert distance == pytest.approx(4 / 2 + 4 / 3 + 4 / 4)


def test_rotate_turns_about_the_frames_axes_but_not_too_far() -> None:
    state = estimates()
    for vector, turned in (([0.3, -0.2, 0.5], 1.0), ([0.0, 3.0, 0.0], 0.5)):
        after = state.copy()
        rotate(after[0, 0], 4, *vector)
        wanted = Rotation.from_rotvec(np.array(vector) * turned).as_matrix()
        np.testing.assert_allclose(
            orientations(after)[4], wanted @ orientations(state)[4], atol=1e-8
        )
        np.testing.assert_array_equal(orientations(after)[3], orientations(state)[3])
