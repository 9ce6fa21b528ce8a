from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.disturbances import (
    BiasWalk,
    DelayLine,
    Disturbances,
    bumps,
    measured,
    patch_factors,
    push_axes,
    roll_steps,
)

COUNT = 4000
TIPS = np.random.default_rng(1).uniform(-0.1, 0.1, (COUNT, 3))
# Five standard errors of a mean of numbers with standard deviation 1.
FIVE = 5.0 / np.sqrt(COUNT)


def error(disturbances: Disturbances, exposure: int = 1, seed: int = 1) -> FloatArray:
    return measured(TIPS, disturbances, seed, exposure, 0) - TIPS


def fits(sample: FloatArray, spread: Any) -> bool:
    """Return whether numbers have a distribution: then p is uniform, and < 1e-4 once in 10,000."""
    return bool(stats.kstest(sample.ravel(), spread.cdf, method="asymp").pvalue > 1e-4)


def check_isotropic(off: FloatArray) -> None:
    """Check that vectors have any direction: each coordinate on the sphere is uniform."""
    unit = off / np.linalg.norm(off, axis=1)[:, np.newaxis]
    for coordinate in unit.T:
        assert fits(coordinate, stats.uniform(-1.0, 2.0))
    assert np.all(np.abs(np.corrcoef(unit.T) - np.eye(3)) < FIVE)


@pytest.mark.parametrize(
    ("shape", "spread"),
    [
        ("uniform", stats.uniform(-0.001, 0.002)),
        ("normal", stats.norm(0.0, 0.001)),
        ("student", stats.t(3.0, 0.0, 0.001)),
    ],
)
def test_noise_has_its_distribution_and_is_independent(shape: str, spread: Any) -> None:
    noise = Disturbances(noise=0.001, noise_shape=shape)
    off = error(noise)
    assert fits(off, spread)
    others = (error(noise, exposure=2), error(noise, seed=2))
    columns = np.column_stack([off, *others])
    # By rank, because Student's t has no fourth moment.
    assert np.all(np.abs(stats.spearmanr(columns).statistic - np.eye(9)) < FIVE)
    np.testing.assert_array_equal(error(Disturbances(noise_shape=shape)), 0.0)


@pytest.mark.parametrize("exposure", [1, 40])
def test_noise_that_lasts_has_its_amplitude_and_correlation_at_every_exposure(
    exposure: int,
) -> None:
    noise = Disturbances(noise=0.001, noise_shape="normal", noise_lasting=0.8)
    before, now, later = (error(noise, exposure=exposure + k) for k in (-1, 0, 2))
    np.testing.assert_allclose(np.std(now, axis=0), 0.001, rtol=0.05)
    for other, wanted in ((before, 0.8), (later, 0.8**2)):
        found = [np.corrcoef(other[:, k], now[:, k])[0, 1] for k in range(3)]
        np.testing.assert_allclose(found, wanted, atol=0.05)


def test_outliers_have_the_requested_share_and_distance_in_any_direction() -> None:
    off = error(Disturbances(noise=0.001, outliers=0.3))
    size = np.linalg.norm(off, axis=1)
    far = size > 0.002
    assert abs(np.mean(far) - 0.3) < FIVE * np.sqrt(0.3 * 0.7)
    assert fits(size[far], stats.uniform(0.005, 0.005))
    check_isotropic(off[far])
    size = np.linalg.norm(error(Disturbances(outliers=1.0, outlier_size=(0.002, 0.0035))), axis=1)
    assert 0.002 - 1e-9 <= size.min() < 0.00201
    assert 0.00349 < size.max() <= 0.0035


def test_dropped_tips_are_missing_completely_and_others_unchanged() -> None:
    kept = measured(TIPS, Disturbances(noise=0.001), 1, 1, 0)
    seen = measured(TIPS, Disturbances(noise=0.001, found=0.8), 1, 1, 0)
    missing = np.isnan(seen)
    assert np.all(missing.all(axis=1) == missing.any(axis=1))
    assert abs(np.mean(missing[:, 0]) - 0.2) < FIVE * np.sqrt(0.2 * 0.8)
    np.testing.assert_array_equal(seen[~missing], kept[~missing])
    # The first tip is never missing, and never an outlier.
    all_wrong = Disturbances(noise=0.001, outliers=1.0, found=0.0)
    assert np.all(np.abs(error(all_wrong, exposure=0)) <= 0.001 + 1e-12)


def test_bumps_have_one_size_in_any_direction_and_patches_are_uniform_and_independent() -> None:
    moved = bumps(0.002, 1, 0, COUNT)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 0.002, rtol=1e-9)
    check_isotropic(moved)
    factors = np.array([patch_factors(0.2, 1, patch, 0, COUNT) for patch in range(3)])
    for each in factors:
        assert fits(each, stats.uniform(0.8, 0.4))
    assert np.all(np.abs(np.corrcoef(factors) - np.eye(3)) < FIVE)


def test_pushes_are_across_z_in_any_direction_and_roll_steps_normal_and_independent() -> None:
    axes = push_axes(2.0, 1, 0, COUNT)
    np.testing.assert_allclose(np.linalg.norm(axes[:, :2], axis=1), 2.0)
    np.testing.assert_array_equal(axes[:, 2], 0.0)
    assert fits(np.arctan2(axes[:, 1], axes[:, 0]), stats.uniform(-np.pi, 2.0 * np.pi))
    steps = np.array([roll_steps(0.1, 1, step, 0, COUNT) for step in (1, 2, 3)])
    assert fits(steps, stats.norm(0.0, 0.1))
    assert np.all(np.abs(np.corrcoef(steps) - np.eye(3)) < FIVE)


def test_a_bias_walks_by_tenths_within_its_bounds_and_stays_spread_evenly() -> None:
    walk = BiasWalk(0.001, 1, 0, COUNT)
    bias = np.array([walk.at(exposure) for exposure in range(60)])
    assert np.abs(bias).max() <= 0.001 + 1e-12
    for exposure in (0, 59):
        assert fits(bias[exposure], stats.uniform(-0.001, 0.002))
    steps = np.diff(bias, axis=0)
    inside = np.abs(bias[:-1]) < 0.0009
    np.testing.assert_allclose(np.abs(steps[inside]), 0.0001, atol=1e-12)
    # Up and down equally often, independent of the previous step.
    assert abs(np.mean(steps > 0.0) - 0.5) < 0.01
    assert abs(np.corrcoef(steps[0].ravel(), steps[1].ravel())[0, 1]) < FIVE + 0.1
    # Each needle has its own, wherever a part begins.
    np.testing.assert_array_equal(BiasWalk(0.001, 1, 41, 5).at(1), bias[1, 41:46])


@pytest.mark.parametrize("steps", [0, 3])
def test_a_late_measurement_has_its_age(steps: int) -> None:
    line = DelayLine(steps)
    for exposure in range(1, 8):
        tips, age = line.push(np.full((2, 3), float(exposure)), 0.001 * exposure)
        if exposure <= steps:
            assert np.all(np.isnan(tips))
        else:
            np.testing.assert_array_equal(tips, exposure - steps)
            assert age == pytest.approx(0.001 * steps)
