"""Updates by one tip: truncated normal moments, bounded and Gaussian noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal, norm, truncnorm

from needle_controller.arrays import Array
from needle_controller.tip_update import (
    SMALLEST_MASS,
    bounded_update,
    gaussian_update,
    squared_distance,
    truncated_moments,
)

SCALES = np.array([3e-4, 3e-4, 3e-4, 0.1, 0.1, 0.3, 1.0, 0.1])


def prior(seed: int = 3) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(8, 8)) * SCALES[:, None]
    rotation = Rotation.random(random_state=seed).as_matrix()
    return rng.normal(0.0, 0.01, 3), rotation, factor @ factor.T


@pytest.mark.parametrize(
    ("lower", "upper"),
    [(-1, 1), (-0.2, 3), (1, 4), (-4, -1), (3.5, 9), (-9, -3.5), (-8, 8), (-6, 0.5), (4, 4.5)],
)
def test_moments_of_the_truncated_normal(lower: float, upper: float) -> None:
    mass, mean, variance = truncated_moments(float(lower), float(upper))
    reference = truncnorm(lower, upper)
    assert mean == pytest.approx(reference.mean(), abs=3e-5)
    assert variance == pytest.approx(reference.var(), abs=3e-5)
    assert mass == pytest.approx(_mass(lower, upper), rel=1e-4)


def _mass(lower: float, upper: float) -> float:
    below, above = (norm.cdf, norm.sf)
    if lower < 0.0:
        return float(below(upper) - below(lower))
    return float(above(lower) - above(upper))


def test_a_prior_far_outside_says_so() -> None:
    mass, mean, variance = truncated_moments(7.0, 9.0)
    assert mass < SMALLEST_MASS
    assert (mean, variance) == (0.0, 0.0)


def test_bounded_update_has_the_posteriors_moments() -> None:
    """Against samples of the prior, those in the box kept; one coordinate measured."""
    rng = np.random.default_rng(4)
    position, rotation, covariance = np.zeros(3), np.eye(3), np.zeros((8, 8))
    covariance[np.ix_([0, 4, 6], [0, 4, 6])] = [
        [2.5e-7, 3e-5, 2e-4],
        [3e-5, 0.01, 0.02],
        [2e-4, 0.02, 1.0],
    ]
    covariance[1, 1] = covariance[2, 2] = 1e-12
    samples = rng.multivariate_normal(np.zeros(8), covariance, 400_000)
    tip, bound = np.array([0.0012, 0.0, 0.0]), 0.001
    kept = samples[np.abs(samples[:, 0] - tip[0]) <= bound]
    change = np.empty(8)
    likelihood = bounded_update(position, rotation, covariance, tip, bound, 0.0, 1e-9, change)
    assert np.exp(likelihood) == pytest.approx(len(kept) / len(samples), rel=0.02)
    deviation = np.sqrt(np.diag(np.cov(kept.T)))
    used = [0, 4, 6]
    np.testing.assert_allclose(
        change[used] / deviation[used], kept.mean(axis=0)[used] / deviation[used], atol=0.02
    )
    scale = np.outer(deviation, deviation)[np.ix_(used, used)]
    wanted = np.cov(kept.T)[np.ix_(used, used)]
    np.testing.assert_allclose(covariance[np.ix_(used, used)] / scale, wanted / scale, atol=0.02)
    assert position[0] == change[0] > 0.0
    np.testing.assert_allclose(rotation, Rotation.from_rotvec(change[3:6]).as_matrix(), atol=1e-12)


def test_a_tip_that_surprises_nobody_changes_nothing() -> None:
    position, rotation, covariance = prior()
    covariance *= 0.01
    before = position.copy(), rotation.copy(), covariance.copy()
    change = np.empty(8)
    likelihood = bounded_update(
        position, rotation, covariance, position + 1e-4, 0.001, 0.0, 0.05, change
    )
    assert likelihood == 0.0
    for now, then in zip((position, rotation, covariance), before, strict=True):
        np.testing.assert_array_equal(now, then)


@pytest.mark.parametrize("offset", [0.003, -0.003])
def test_a_prior_outside_the_box_is_taken_to_its_edge(offset: float) -> None:
    position, rotation, covariance = np.zeros(3), np.eye(3), np.eye(8) * 1e-10
    bounded_update(
        position, rotation, covariance, np.array([offset, 0.0, 0.0]), 0.001, 0.0, 0.05, np.empty(8)
    )
    assert position[0] == pytest.approx(offset - np.copysign(0.001, offset))
    assert 0.0 < covariance[0, 0] < 1e-10


def test_gaussian_update_is_kalmans() -> None:
    position, rotation, covariance = prior()
    noise = np.array([[4e-7, 1e-7, 0.0], [1e-7, 9e-7, -2e-7], [0.0, -2e-7, 2.5e-7]])
    tip = position + np.array([4e-4, -7e-4, 1e-3])
    measured = np.eye(8)[:3]
    spread = measured @ covariance @ measured.T + noise
    gain = covariance @ measured.T @ np.linalg.inv(spread)
    wanted_change = gain @ (tip - position)
    keep = np.eye(8) - gain @ measured
    wanted = keep @ covariance @ keep.T + gain @ noise @ gain.T
    density = multivariate_normal(position, spread).logpdf(tip)
    end = position + wanted_change[:3]
    turned = Rotation.from_rotvec(wanted_change[3:6]).as_matrix() @ rotation
    change = np.empty(8)
    likelihood = gaussian_update(
        position, rotation, covariance, tip, noise, change, np.empty((8, 3))
    )
    np.testing.assert_allclose(change, wanted_change, rtol=1e-6)
    np.testing.assert_allclose(covariance, wanted, rtol=1e-5, atol=1e-14)
    np.testing.assert_array_equal(covariance, covariance.T)
    np.testing.assert_allclose(position, end)
    np.testing.assert_allclose(rotation, turned, atol=1e-12)
    assert likelihood - 1.5 * np.log(2.0 * np.pi) == pytest.approx(density)


def test_squared_distance_adds_the_coordinates() -> None:
    covariance = np.diag([1.0, 2.0, 3.0, 0, 0, 0, 0, 0])
    distance = squared_distance(np.zeros(3), covariance, np.array([2.0, 2.0, 2.0]), np.eye(3))
    assert distance == pytest.approx(4 / 2 + 4 / 3 + 4 / 4)


def test_no_single_tip_is_proof() -> None:
    """However far off: each coordinate costs at most the logarithm of `surprise`."""
    likelihoods = [
        bounded_update(
            np.zeros(3),
            np.eye(3),
            np.eye(8) * 1e-10,
            np.array([offset, 0.0, 0.0]),
            0.001,
            0.0,
            0.05,
            np.empty(8),
        )
        for offset in (0.00102, 0.0011, 0.005)
    ]
    assert likelihoods[0] > likelihoods[1] >= likelihoods[2] == pytest.approx(np.log(0.05))
