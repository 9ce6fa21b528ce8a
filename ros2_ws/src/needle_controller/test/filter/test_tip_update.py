"""Updates by one tip: uniform and normal noise, outliers, learning of the noise."""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal, norm, truncnorm

from needle_controller.filter.filter_settings import (
    CORRELATED,
    NORMAL,
    UNIFORM,
    FilterSettings,
    NoiseHypothesis,
)
from needle_controller.filter.records import E_KAPPA, E_SCALE, ERROR, HYPOTHESIS
from needle_controller.filter.tip_update import (
    new_reading,
    new_workspace,
    prepare_reading,
    truncated_moments,
    update_hypothesis,
)
from needle_controller.model.arrays import Array

SCALES = np.array([3e-4, 3e-4, 3e-4, 0.1, 0.1, 0.3, 1.0, 0.1, 0.05])
COUNT = 8
BOUND = 0.001
CLAIMED = np.eye(3) * BOUND**2 / 3.0
MIDDLE = np.array([0.01, 0.02, 0.03])
PLAIN = FilterSettings(outlier_share=1e-6, curvature_range=(0.01, 100.0))
LASTS = dataclasses.replace(
    PLAIN,
    model_error=0.0,
    noise_hypotheses=(NoiseHypothesis(CORRELATED, (1.0,), (1.0,), 1.0, (0.6,)),),
)
Records = npt.NDArray[np.void]


def estimates(covariance: Array | None = None, shape: int = NORMAL) -> Records:
    """Eight different estimates about `MIDDLE`; noise as claimed."""
    rng = np.random.default_rng(3)
    h = np.zeros(COUNT, HYPOTHESIS)
    h["position"] = MIDDLE
    h["rotation"] = Rotation.random(COUNT, random_state=3).as_matrix()
    if covariance is None:
        h["position"] += rng.normal(0.0, 1e-3, (COUNT, 3))
        factor = rng.normal(size=(COUNT, ERROR, ERROR)) * SCALES[:, None]
        covariance = factor @ np.swapaxes(factor, -1, -2)
    h["covariance"] = covariance
    h["curvature"], h["scale"], h["play"] = 8.0, 1.0, 0.5
    h["weight"] = 1.0
    h["noise_weights"][:, :, 0] = 1.0
    h["shape"] = shape
    return h


def taken(
    before: Records, tip: Array, noise: Array = CLAIMED, settings: FilterSettings = PLAIN
) -> Records:
    after: Records = before.copy()
    reading, work = new_reading(np.array(tip), np.array(noise), np.zeros(4)), new_workspace()
    assert prepare_reading(reading)
    for h in after:
        update_hypothesis(h, reading, settings.assumptions(), work)
    return after


def changes(before: Records, after: Records) -> Array:
    """Change of the nine elements of the error, (COUNT, 9)."""
    turned = after["rotation"] @ np.swapaxes(before["rotation"], -1, -2)
    turn = Rotation.from_matrix(turned).as_rotvec()
    other = [after[name] - before[name] for name in ("curvature", "play", "scale")]
    return np.column_stack([after["position"] - before["position"], turn, *other])


@pytest.mark.parametrize(
    ("lower", "upper"), [(-1.0, 0.5), (0.3, 2.0), (-9.0, 1.0), (-7.0, 8.0), (3.0, 4.5)]
)
def test_truncated_moments_equal_scipys(lower: float, upper: float) -> None:
    mass, mean, variance = truncated_moments(lower, upper)
    cut = truncnorm(lower, upper)
    assert mass == pytest.approx(norm.cdf(upper) - norm.cdf(lower), rel=1e-5)
    assert mean == pytest.approx(cut.mean(), abs=1e-5)
    assert variance == pytest.approx(cut.var(), abs=1e-4)
    # Mirrored bounds.
    other = truncated_moments(-upper, -lower)
    np.testing.assert_allclose(other, [mass, -mean, variance], rtol=1e-9, atol=1e-12)


def test_uniform_noise_gives_the_posteriors_moments() -> None:
    """Compare with samples of the prior inside the noise box; one coordinate is measured."""
    rng = np.random.default_rng(4)
    covariance = np.zeros((ERROR, ERROR))
    used = [0, 4, E_KAPPA, E_SCALE]
    covariance[np.ix_(used, used)] = [
        [2.5e-7, 3e-5, 2e-4, 1e-5],
        [3e-5, 0.01, 0.02, 1e-3],
        [2e-4, 0.02, 1.0, 0.0],
        [1e-5, 1e-3, 0.0, 0.01],
    ]
    covariance[1, 1] = covariance[2, 2] = 1e-12
    samples = rng.multivariate_normal(np.zeros(ERROR), covariance, 400_000)
    before = estimates(covariance, UNIFORM)
    kept = samples[np.abs(samples[:, 0] - 0.0012) <= BOUND]
    after = taken(before, MIDDLE + np.array([0.0012, 0.0, 0.0]))
    np.testing.assert_allclose(after["evidence"], len(kept) / len(samples), rtol=0.02)
    kept, found = kept[:, used], changes(before, after)[2, used]
    deviation = np.std(kept, axis=0)
    np.testing.assert_allclose(found / deviation, kept.mean(axis=0) / deviation, atol=0.02)
    found, scale = after["covariance"][2][np.ix_(used, used)], np.outer(deviation, deviation)
    np.testing.assert_allclose(found / scale, np.cov(kept.T) / scale, atol=0.02)


DEPENDENT = np.array([[4e-7, 1e-7, 0.0], [1e-7, 9e-7, -2e-7], [0.0, -2e-7, 2.5e-7]])


def test_normal_noise_gives_kalmans_update() -> None:
    before = estimates()
    tip = np.array([0.0105, 0.0193, 0.031])
    after = taken(before, tip, DEPENDENT)
    measured = np.eye(ERROR)[:3]
    found = changes(before, after)
    for h in range(COUNT):
        covariance, expected = before["covariance"][h], before["position"][h]
        spread = measured @ covariance @ measured.T + DEPENDENT
        gain = covariance @ measured.T @ np.linalg.inv(spread)
        wanted = gain @ (tip - expected)
        np.testing.assert_allclose(found[h, :7], wanted[:7], rtol=1e-4, atol=1e-8)
        keep = np.eye(ERROR) - gain @ measured
        wanted = keep @ covariance @ keep.T + gain @ DEPENDENT @ gain.T
        scale = np.outer(np.sqrt(np.diag(wanted)), np.sqrt(np.diag(wanted)))
        np.testing.assert_allclose(after["covariance"][h] / scale, wanted / scale, atol=2e-4)
        # Relative to the density of uniform noise of the same variances.
        density = multivariate_normal(expected, spread).pdf(tip)
        in_box = 1.0 / np.sqrt(12.0**3 * np.linalg.det(DEPENDENT))
        assert after["evidence"][h] == pytest.approx(density / in_box, rel=1e-4)


def test_correlated_errors_are_separated_from_the_estimates_own() -> None:
    """Against a Kalman filter whose state includes the tip's error."""
    known = np.array([2e-4, 4e-4, 5e-4]) ** 2
    before = estimates(np.diag([*known, *SCALES[3:] ** 2]), CORRELATED)
    rest = np.array([7e-4, -2e-4, 1e-4])
    before["residual"] = rest
    off = np.array([1e-3, 3e-4, -8e-4])
    after = taken(before, MIDDLE + off, settings=LASTS)
    likelihood = 1.0
    for axis in range(3):
        # Errors of estimate and tip, whose sum was observed at the tip before.
        mean = np.array([0.0, 0.6 * rest[axis]])
        covariance = known[axis] * np.array([[1.0, -0.6], [-0.6, 0.36]])
        covariance[1, 1] += (1.0 - 0.6**2) * BOUND**2 / 3.0
        variance = covariance.sum()
        gain = covariance.sum(axis=1) / variance
        innovation = off[axis] - mean.sum()
        wanted = mean + gain * innovation
        np.testing.assert_allclose(changes(before, after)[:, axis], wanted[0], rtol=1e-4)
        np.testing.assert_allclose(after["residual"][:, axis], wanted[1], rtol=1e-4)
        left = covariance[0, 0] - gain[0] ** 2 * variance
        np.testing.assert_allclose(after["covariance"][:, axis, axis], left, rtol=1e-4)
        likelihood *= 2.0 * BOUND * norm.pdf(innovation, scale=np.sqrt(variance))
    np.testing.assert_allclose(after["evidence"], likelihood, rtol=1e-4)


def test_a_wide_prior_removes_no_correlated_error() -> None:
    before = estimates(np.eye(ERROR) * 0.02**2, CORRELATED)
    after = taken(before, MIDDLE + 0.01, settings=LASTS)
    np.testing.assert_allclose(changes(before, after)[:, :3], 0.01, rtol=0.005)


def test_the_noisier_coordinate_is_learnt() -> None:
    noise = NoiseHypothesis(CORRELATED, (1.0, 2.0), (0.5, 0.5), 1.0, (0.0, 0.0))
    settings = dataclasses.replace(PLAIN, noise_hypotheses=(noise,))
    known, rng = estimates(np.eye(ERROR) * 1e-10, CORRELATED), np.random.default_rng(5)
    weights = known["noise_weights"]
    weights[:, :, :2] = 0.5
    for _ in range(60):
        off = rng.normal(size=3) * [2.0, 1.0, 0.3] * BOUND / np.sqrt(3.0)
        # The estimates themselves stay.
        weights[:] = taken(known, MIDDLE + off, settings=settings)["noise_weights"]
    assert np.all(weights[:, 0, 1] > 0.9)
    assert np.all(weights[:, 1:, 0] > 0.9)


def test_an_exact_tip_is_used() -> None:
    after = taken(estimates(), MIDDLE, np.zeros((3, 3)))
    for name in HYPOTHESIS.names or ():
        assert np.all(np.isfinite(after[name]))


def test_a_doubtful_tip_gives_the_mixtures_moments() -> None:
    """Probability 1/2 of an outlier: the mixture of the old and the updated covariance."""
    before = estimates(np.diag((SCALES * 0.3) ** 2))
    tip = MIDDLE + np.array([0.0022, 0.0, 0.0])
    whole, after = taken(before, tip), taken(before, tip, settings=FilterSettings())
    share = after["outlier"][0]
    assert 0.1 < share < 0.9
    change = changes(before, whole)[0]
    np.testing.assert_allclose(changes(before, after)[0], (1.0 - share) * change, atol=1e-7)
    wanted = share * before["covariance"][0] + (1.0 - share) * whole["covariance"][0]
    wanted += share * (1.0 - share) * np.outer(change, change)
    np.testing.assert_allclose(np.diag(after["covariance"][0]), np.diag(wanted), rtol=1e-4)


@pytest.mark.parametrize("shape", [NORMAL, UNIFORM])
def test_the_size_of_the_noise_is_learnt(shape: int) -> None:
    settings, rng, true = FilterSettings(), np.random.default_rng(8), 1.6
    multiples, shares, _ = settings.noises()[shape]
    known = estimates(np.diag((SCALES * 0.1) ** 2), shape)
    known["noise_weights"][:, 0] = shares
    for _ in range(30):
        noise = rng.normal(0, 1 / np.sqrt(3.0), 3) if shape == NORMAL else rng.uniform(-1, 1, 3)
        known = taken(known, MIDDLE + true * BOUND * noise, settings=settings)
    likeliest = multiples[np.argmax(known["noise_weights"][0, 0])]
    assert likeliest == min(m for m in multiples if m >= true)
    np.testing.assert_allclose(np.sum(known["noise_weights"][:, 0], axis=1), 1.0)
