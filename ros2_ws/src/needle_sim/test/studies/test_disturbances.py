from __future__ import annotations

import numpy as np
import pytest
from numpy.random import default_rng
from scipy import stats

from needle_sim.needle.se3 import FloatArray
from needle_sim.studies import study_noise
from needle_sim.studies.disturbances import (
    DelayLine,
    Disturbances,
    bumps,
    measured,
    patch_factors,
)

COUNT = 20_000
TIPS = default_rng(1).uniform(-0.1, 0.1, (COUNT, 3))


def error(disturbances: Disturbances, exposure: int = 1, seed: int = 1) -> FloatArray:
    return measured(TIPS, disturbances, seed, exposure, 0) - TIPS


def test_noise_is_uniform_independent_and_bounded() -> None:
    share = error(Disturbances(noise=0.001)) / 0.001
    assert np.all(np.abs(share) <= 1.0 + 1e-9)
    assert np.max(np.abs(share)) > 0.999
    np.testing.assert_allclose(np.std(share, axis=0), 1.0 / np.sqrt(3.0), rtol=0.02)
    assert np.all(np.abs(np.mean(share, axis=0)) < 0.02)
    assert np.all(np.abs(np.corrcoef(share.T) - np.eye(3)) < 0.03)


def test_normal_noise_is_normal_with_its_amplitude_as_standard_deviation() -> None:
    off = error(Disturbances(noise=0.001, noise_shape="normal"))
    assert np.all(np.isfinite(off))
    # of a sample of a normal distribution the test's p is uniform: 1e-4 is one seed in 10,000
    assert stats.kstest(off.ravel(), stats.norm(0.0, 0.001).cdf).pvalue > 1e-4
    assert 0.004 < np.max(np.abs(off)) < 0.0055
    assert np.all(np.abs(np.corrcoef(off.T) - np.eye(3)) < 0.03)


@pytest.mark.parametrize("exposure", [1, 2, 40])
def test_noise_that_lasts_has_its_amplitude_and_correlation_at_every_exposure(
    exposure: int,
) -> None:
    noise = Disturbances(noise=0.001, noise_shape="normal", noise_lasting=0.8)
    before, now, later = (error(noise, exposure=exposure + k) for k in (-1, 0, 2))
    np.testing.assert_allclose(np.std(now, axis=0), 0.001, rtol=0.03)
    for other, wanted in ((before, 0.8), (later, 0.8**2)):
        found = [np.corrcoef(other[:, k], now[:, k])[0, 1] for k in range(3)]
        np.testing.assert_allclose(found, wanted, atol=0.03)


def test_noise_differs_between_exposures_and_seeds_and_is_none_at_0() -> None:
    noise = Disturbances(noise=0.001)
    base = error(noise)
    for other in (error(noise, exposure=2), error(noise, seed=2)):
        assert abs(np.corrcoef(base.ravel(), other.ravel())[0, 1]) < 0.02
    np.testing.assert_array_equal(error(Disturbances()), 0.0)


@pytest.mark.parametrize("share", [0.05, 0.5])
def test_outliers_are_off_by_5_to_10_mm_in_any_direction(share: float) -> None:
    off = error(Disturbances(noise=0.001, outliers=share))
    size = np.linalg.norm(off, axis=1)
    is_outlier = size > 0.002
    # five standard errors of a share
    assert abs(np.mean(is_outlier) - share) < 5.0 * np.sqrt(share * (1.0 - share) / COUNT)
    assert 0.005 <= size[is_outlier].min() < 0.0051
    assert 0.0099 < size[is_outlier].max() <= 0.010
    direction = off[is_outlier] / size[is_outlier, np.newaxis]
    count = len(direction)
    assert np.all(np.abs(np.mean(direction, axis=0)) < 5.0 / np.sqrt(3.0 * count))
    # on the sphere each coordinate is uniform
    np.testing.assert_allclose(np.mean(direction**2, axis=0), 1.0 / 3.0, atol=2.0 / np.sqrt(count))


def test_outliers_are_as_far_off_as_asked() -> None:
    size = np.linalg.norm(error(Disturbances(outliers=1.0, outlier_size=(0.002, 0.0035))), axis=1)
    assert 0.002 - 1e-9 <= size.min() < 0.00201
    assert 0.00349 < size.max() <= 0.0035
    assert abs(np.mean(size) - 0.00275) < 5.0 * 0.0015 / np.sqrt(12.0 * COUNT)


def test_bumps_are_of_one_size_in_any_direction_and_one_for_each_needle() -> None:
    moved = bumps(0.002, 1, 0, COUNT)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 0.002, rtol=1e-9)
    assert np.all(np.abs(np.mean(moved, axis=0)) < 5.0 * 0.002 / np.sqrt(3.0 * COUNT))
    np.testing.assert_allclose(np.std(moved, axis=0), 0.002 / np.sqrt(3.0), rtol=0.02)
    np.testing.assert_array_equal(bumps(0.002, 1, 40, 5), moved[40:45])
    # independent of which way outliers are off
    outliers = error(Disturbances(outliers=1.0))
    assert abs(np.corrcoef(moved[:, 0], outliers[:, 0])[0, 1]) < 0.03


def test_dropped_tips_are_missing_whole_and_the_others_untouched() -> None:
    kept = measured(TIPS, Disturbances(noise=0.001), 1, 1, 0)
    seen = measured(TIPS, Disturbances(noise=0.001, dropped=0.2), 1, 1, 0)
    missing = np.isnan(seen)
    assert np.all(missing.all(axis=1) == missing.any(axis=1))
    assert abs(np.mean(missing[:, 0]) - 0.2) < 5.0 * np.sqrt(0.2 * 0.8 / COUNT)
    np.testing.assert_array_equal(seen[~missing], kept[~missing])


def test_the_first_tip_is_there_and_no_outlier() -> None:
    all_wrong = Disturbances(noise=0.001, outliers=1.0, dropped=1.0)
    assert np.all(np.abs(error(all_wrong, exposure=0)) <= 0.001 + 1e-12)


@pytest.mark.parametrize("steps", [0, 1, 3])
def test_a_late_measurement_comes_with_its_age(steps: int) -> None:
    line = DelayLine(steps)
    for exposure in range(1, 8):
        tips, age = line.pass_on(np.full((2, 3), float(exposure)), 0.001 * exposure)
        if exposure <= steps:
            assert np.all(np.isnan(tips))
        else:
            np.testing.assert_array_equal(tips, exposure - steps)
            assert age == pytest.approx(0.001 * steps)


def test_patches_are_uniform_and_anew_each_time() -> None:
    factors = np.array([patch_factors(0.2, 1, patch, 0, COUNT) for patch in range(3)])
    assert np.all(np.abs(factors - 1.0) <= 0.2)
    np.testing.assert_allclose(np.std(factors, axis=1), 0.2 / np.sqrt(3.0), rtol=0.03)
    assert np.all(np.abs(np.corrcoef(factors) - np.eye(3)) < 0.03)


@pytest.mark.parametrize("purpose", [study_noise.NOISE, study_noise.CURVATURE])
def test_a_needle_s_numbers_do_not_depend_on_its_company(purpose: int) -> None:
    whole = study_noise.uniform(3, purpose, 7, 0, 100)
    np.testing.assert_array_equal(study_noise.uniform(3, purpose, 7, 40, 5), whole[40:45])
