"""Tips with a stated age, too old tips, missing tips."""

from __future__ import annotations

import numpy as np

from needle_controller.filter.filter_settings import FilterSettings
from needle_controller.filter.hypothesis_filter import HypothesisFilter

from .needles import STEP, drive, noisy, path, turns_for


def test_a_late_tip_is_used_at_its_exposure() -> None:
    """A filter with tips one step late equals the punctual one predicted by one step."""
    turns = turns_for(40)
    tips = noisy(path(turns))
    late, on_time = (HypothesisFilter(FilterSettings()) for _ in range(2))
    late.reset(tips[0], np.zeros(2))
    on_time.reset(tips[0], np.zeros(2))
    for k, turn in enumerate(turns):
        late.advance(STEP, turn)
        if k > 0:
            late.correct(tips[k], age=STEP)
        on_time.advance(STEP, turn)
        if k + 1 < len(turns):
            on_time.correct(tips[k + 1])
    for name in ("coordinates", "linearized", "curvature", "covariance"):
        np.testing.assert_allclose(
            getattr(late.estimate(), name),
            getattr(on_time.estimate(), name),
            atol=1e-9,
            err_msg=name,
        )


def test_a_late_tip_between_two_stops() -> None:
    """An exposure within an advance divides the advance."""
    turns = turns_for(20)
    tips = noisy(path(turns))
    one, two = (HypothesisFilter(FilterSettings()) for _ in range(2))
    for estimator in (one, two):
        drive(estimator, turns, tips)
    one.advance(STEP, 0.2)
    one.correct(tips[-1] + [0.0, 0.0, 0.0006], age=0.0004)
    two.advance(0.0006, 0.12)
    two.correct(tips[-1] + [0.0, 0.0, 0.0006])
    two.advance(0.0004, 0.08)
    np.testing.assert_allclose(one.estimate().coordinates, two.estimate().coordinates, atol=1e-12)


def test_a_tip_older_than_the_last_is_dropped_and_reported() -> None:
    turns = turns_for(20)
    estimator = HypothesisFilter(FilterSettings())
    before = drive(estimator, turns, noisy(path(turns)))
    estimator.correct(np.array([0.0, 0.0, 0.015]), age=0.005)
    after = estimator.estimate()
    np.testing.assert_array_equal(after.coordinates, before.coordinates)
    assert any("older" in warning for warning in after.warnings)
    estimator.advance(STEP, 0.0)
    estimator.correct(np.full(3, np.nan))
    assert not any("older" in warning for warning in estimator.estimate().warnings)


def test_missing_tips_change_nothing() -> None:
    turns = turns_for(30)
    tips = noisy(path(turns))
    with_missing, without = (HypothesisFilter(FilterSettings()) for _ in range(2))
    for estimator in (with_missing, without):
        drive(estimator, turns[:20], tips[:21])
    for turn in turns[20:]:
        with_missing.advance(STEP, turn)
        with_missing.correct(np.array([np.nan, 0.0, 0.0]))
        without.advance(STEP, turn)
    np.testing.assert_allclose(
        with_missing.estimate().coordinates, without.estimate().coordinates, atol=1e-12
    )
    covariance = np.diag(with_missing.estimate().covariance)
    np.testing.assert_allclose(covariance, np.diag(without.estimate().covariance), rtol=1e-9)
    with_missing.correct(np.zeros(3), np.full((3, 3), np.inf))
    np.testing.assert_allclose(np.diag(with_missing.estimate().covariance), covariance)
