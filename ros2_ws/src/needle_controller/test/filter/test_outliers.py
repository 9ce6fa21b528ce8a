"""Outliers and displaced needles."""

from __future__ import annotations

import numpy as np

from needle_controller.filter.filter_settings import FilterSettings
from needle_controller.filter.hypothesis_filter import HypothesisFilter
from needle_controller.filter.records import ERROR

from .needles import STEP, drive, noisy, path, turns_for


def test_an_outlier_is_ignored_and_a_jump_is_followed() -> None:
    turns = turns_for(60)
    tips = noisy(path(turns))
    estimator = HypothesisFilter(FilterSettings())
    before = drive(estimator, turns[:40], tips[:41])
    far = np.array([0.003, 0.0, 0.0])
    estimator.correct(tips[40] + far)
    after = estimator.estimate()
    assert any("outlier" in warning for warning in after.warnings)
    np.testing.assert_allclose(after.position, before.position, atol=0.0006)
    estimator.correct(tips[40])
    np.testing.assert_allclose(estimator.estimate().position, before.position, atol=0.0003)
    for turn, tip in zip(turns[40:46], tips[41:47], strict=True):
        estimator.advance(STEP, turn)
        estimator.correct(tip + far)
    moved = estimator.estimate()
    np.testing.assert_allclose(moved.position, path(turns)[46, :3, 3] + far, atol=0.0008)
    assert not moved.warnings


def test_displaced_hypotheses_have_the_tips_covariance() -> None:
    turns, settings = turns_for(20), FilterSettings()
    tips, estimator = path(turns)[:, :3, 3], HypothesisFilter(settings)
    noise = 1e-8 * np.array([[4.0, 1.5, -1.0], [1.5, 3.0, 0.5], [-1.0, 0.5, 5.0]])
    drive(estimator, turns, tips, noise)
    seen = tips[20] + np.array([0.002, -0.001, 0.003])
    estimator.correct(seen, noise)
    known = estimator.hypotheses
    displaced = known[np.all(np.isclose(known["position"], seen, atol=1e-12), axis=1)]
    assert len(displaced) > 0
    wanted = np.zeros((3, ERROR))
    wanted[:, :3] = noise + np.eye(3) * settings.model_error**2
    for covariance in displaced["covariance"]:
        np.testing.assert_allclose(covariance[:3], wanted, rtol=1e-9)
