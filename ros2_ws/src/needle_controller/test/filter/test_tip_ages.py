"""Tips with a stated age, too old tips, missing tips."""

from __future__ import annotations

import numpy as np
import pytest

from needle_controller.filter.filter_settings import FilterSettings
from needle_controller.filter.hypothesis_filter import HypothesisFilter

from .needles import STEP, drive, noisy, path, turns_for


@pytest.mark.parametrize("share", [0.4, 1.0])
def test_a_late_tip_is_used_at_its_exposure(share: float) -> None:
    """An age that is a share of each step equals a tip on time and a later prediction."""
    turns = turns_for(40)
    tips = noisy(path(turns))
    late, on_time = (HypothesisFilter(FilterSettings()) for _ in range(2))
    for estimator in (late, on_time):
        estimator.reset(tips[0], np.zeros(2))
        estimator.advance(STEP, 0.1)
    for turn, tip in zip(turns, tips[1:], strict=True):
        late.advance(STEP, turn)
        late.correct(tip, age=share * STEP)
        on_time.advance((1.0 - share) * STEP, (1.0 - share) * turn)
        on_time.correct(tip)
        on_time.advance(share * STEP, share * turn)
    for name in ("coordinates", "linearized", "curvature", "covariance"):
        found, wanted = (getattr(one.estimate(), name) for one in (late, on_time))
        np.testing.assert_allclose(found, wanted, atol=1e-9, err_msg=name)


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
    """Without a position, or with an infinite covariance."""
    turns = turns_for(20)
    with_missing, without = (HypothesisFilter(FilterSettings()) for _ in range(2))
    for estimator in (with_missing, without):
        drive(estimator, turns, noisy(path(turns)))
        estimator.advance(STEP, 0.1)
    with_missing.correct(np.array([np.nan, 0.0, 0.0]))
    with_missing.correct(np.zeros(3), np.full((3, 3), np.inf))
    for name in ("coordinates", "covariance"):
        found, wanted = (getattr(one.estimate(), name) for one in (with_missing, without))
        np.testing.assert_allclose(found, wanted, atol=1e-12)
