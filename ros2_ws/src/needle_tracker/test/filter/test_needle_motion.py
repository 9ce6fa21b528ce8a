"""Motion and correction of the Gaussian state, against simulation and batch least squares."""

from __future__ import annotations

import math

import numpy as np
import pytest

from needle_tracker.filter.needle_track import (
    HEADING,
    POSITION,
    SCALE,
    SIZE,
    ZERO,
    NeedleMotion,
    gaussian,
)
from needle_tracker.filter.settings import FILTER
from needle_tracker.stereo.triangulation import SpatialTip
from needle_tracker.tracker_parameters import StereoTrackerParameters

AHEAD = np.array([0.05, -0.1, 0.99]) / np.linalg.norm([0.05, -0.1, 0.99])


def sighting(position: np.ndarray, sigma: float = 0.1e-3) -> SpatialTip:
    return SpatialTip(position, sigma**2 * np.eye(3), AHEAD, 1e-4 * np.eye(3))


@pytest.fixture
def motion(settings: StereoTrackerParameters) -> NeedleMotion:
    return NeedleMotion.begin(sighting(np.array([0.001, 0.002, 0.05])), settings)


def test_the_needle_advances_along_its_heading_by_the_motion_of_the_stage(
    motion: NeedleMotion, settings: StereoTrackerParameters
) -> None:
    after = motion.advanced(2e-3, settings.max_curvature)
    np.testing.assert_allclose(
        after.mean[POSITION], motion.mean[POSITION] + 2e-3 * AHEAD, atol=1e-12
    )
    back = after.advanced(-2e-3, settings.max_curvature)
    np.testing.assert_allclose(back.mean, motion.mean, atol=1e-12)
    assert np.linalg.eigvalsh(back.covariance)[0] > 0.0


def test_the_covariance_after_a_motion_agrees_with_simulated_needles(
    motion: NeedleMotion, settings: StereoTrackerParameters
) -> None:
    rng, travel = np.random.default_rng(0), 5e-3
    starts = rng.multivariate_normal(motion.mean, motion.covariance, 20_000)
    heading = starts[:, HEADING]
    ends = starts[:, POSITION] + (1.0 + starts[:, [SCALE]]) * travel * heading
    after = motion.advanced(travel, 1e-9)
    slip = (FILTER.slip_sigma * travel) ** 2 * np.outer(AHEAD, AHEAD)
    noise = slip + FILTER.drift_sigma**2 * np.eye(3)
    np.testing.assert_allclose(
        after.covariance[POSITION, POSITION], np.cov(ends.T) + noise, atol=5e-9
    )


def test_an_unknown_motion_spreads_the_tip_along_the_heading_and_across_it(
    motion: NeedleMotion,
) -> None:
    rng, sigma = np.random.default_rng(3), 4e-3
    starts = rng.multivariate_normal(motion.mean, motion.covariance, 40_000)
    ends = starts[:, POSITION] + rng.normal(0.0, sigma, (40_000, 1)) * starts[:, HEADING]
    np.testing.assert_allclose(motion.spread(sigma), np.cov(ends.T), atol=3e-7)


def test_sequential_corrections_equal_one_batch(motion: NeedleMotion) -> None:
    rng = np.random.default_rng(1)
    rows, residuals = rng.normal(size=(6, SIZE)), 1e-3 * rng.normal(size=6)
    variances = rng.uniform(0.5, 2.0, 6) * 1e-6
    information = np.linalg.inv(motion.covariance) + rows.T @ np.diag(1.0 / variances) @ rows
    at = motion.mean + np.linalg.solve(information, rows.T @ (residuals / variances))
    after, mean = motion, motion.mean
    for row, residual, variance in zip(rows, residuals, variances, strict=True):
        left = residual - float(row @ (after.mean - mean))
        after = after.corrected(row[None], np.array([left]), np.array([variance]))
    np.testing.assert_allclose(after.mean, at, atol=1e-9)
    np.testing.assert_allclose(after.covariance, np.linalg.inv(information), atol=1e-12)


def test_an_error_of_the_stage_is_estimated_and_does_not_move_the_tip(
    motion: NeedleMotion, settings: StereoTrackerParameters
) -> None:
    """Zero wrong by 1 mm, scale by 1 %: 60 mm of insertion, a sighting and a length per mm."""
    rng, zero, scale = np.random.default_rng(2), 1e-3, 0.01
    at = motion.mean[POSITION]
    for mm in range(60):
        insertion = 0.05 + 1e-3 * mm
        length = (1.0 + scale) * insertion + zero
        true = at + (length - (1.0 + scale) * 0.05 - zero) * AHEAD
        if mm:
            motion = motion.advanced(1e-3, settings.max_curvature)
        motion = motion.corrected_by_tip(sighting(true + rng.normal(0.0, 0.1e-3, 3)))
        motion = motion.corrected_by_length(length + rng.normal(0.0, 0.2e-3), insertion, 0.4e-3)
    assert np.linalg.norm(motion.mean[POSITION] - true) < 0.15e-3
    total = motion.mean[ZERO] + motion.mean[SCALE] * 0.08
    assert total == pytest.approx(zero + scale * 0.08, abs=0.3e-3)


def test_the_density_is_that_of_a_normal_distribution() -> None:
    covariance = np.diag([1.0, 4.0, 0.25])
    square, log_density = gaussian(np.array([1.0, 2.0, 0.5]), covariance)
    assert square == pytest.approx(3.0)
    expected = -1.5 - 1.5 * math.log(2.0 * math.pi)
    assert log_density == pytest.approx(expected)
