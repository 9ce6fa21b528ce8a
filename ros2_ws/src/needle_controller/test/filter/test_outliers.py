"""Outliers and displaced needles."""

from __future__ import annotations

from typing import Any

import numpy as np

from needle_controller.filter.filter_settings import FilterSettings
from needle_controller.filter.hypothesis_filter import HypothesisFilter

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


def test_outliers_add_displaced_hypotheses_with_their_weight() -> None:
    turns = turns_for(9)
    tips = noisy(path(turns))
    # Early, while several rolls are possible.
    tips[9, 0] += 0.0025

    def hypotheses(jump_share: float) -> Any:
        estimator = HypothesisFilter(FilterSettings(jump_share=jump_share))
        drive(estimator, turns, tips)
        return estimator.hypotheses.copy()

    settings = FilterSettings()
    without = hypotheses(1e-6)
    wanted = settings.jump_share * without["weight"] * without["outlier"]
    wanted = np.sort(wanted[wanted > 1e-3])
    known = hypotheses(settings.jump_share)
    displaced = np.isclose(known["position"][:, 0], tips[9, 0], rtol=0.0, atol=1e-12)
    seen = np.sort(known["weight"][displaced])
    # The likeliest ones, as far as there is storage.
    assert len(seen) > 5
    np.testing.assert_allclose(seen, wanted[-len(seen) :])


def test_displaced_hypotheses_have_the_tips_covariance() -> None:
    turns = turns_for(20)
    tips = path(turns)[:, :3, 3]
    noise = 1e-8 * np.array([[4.0, 1.5, -1.0], [1.5, 3.0, 0.5], [-1.0, 0.5, 5.0]])
    settings = FilterSettings()
    estimator = HypothesisFilter(settings)
    drive(estimator, turns, tips, noise)
    seen = tips[20] + np.array([0.002, -0.001, 0.003])
    estimator.correct(seen, noise)
    known = estimator.hypotheses
    displaced = np.all(np.isclose(known["position"], seen, atol=1e-12), axis=1)
    assert np.count_nonzero(displaced) > 0
    wanted = noise + np.eye(3) * settings.model_error**2
    for covariance in known["covariance"][displaced]:
        np.testing.assert_allclose(covariance[:3, :3], wanted, rtol=1e-9)
        np.testing.assert_allclose(covariance[:3, 3:], 0.0)
