"""Tips that lie short of the insertion from the start: late ones, and others that only look so."""

from __future__ import annotations

import numpy as np
import pytest

from needle_controller.bank.filter_settings import FilterSettings
from needle_controller.bank.hypothesis_filter import HypothesisFilter
from needle_controller.bank.shortfall import FIRST, LAST, Shortfall
from needle_controller.model.arrays import Array

STEP = 0.001
RADIUS = 0.122


def arc(inserted: Array) -> Array:
    """Return tips of a needle that bends, (..., 3) [m]."""
    angle = np.asarray(inserted) / RADIUS
    x = RADIUS * (1.0 - np.cos(angle))
    return np.stack([x, np.zeros_like(x), RADIUS * np.sin(angle)], axis=-1)


def doubts(*, late: int = 0, age: float = 0.0, slip: float = 0.0, bump: float = 0.0) -> str:
    """Return what a filter doubts after 40 mm of tips with +-1 mm noise."""
    rng = np.random.default_rng(7)
    estimator = HypothesisFilter(FilterSettings())
    estimator.reset(rng.uniform(-STEP, STEP, 3), np.zeros(2))
    for k in range(1, 41):
        estimator.advance(STEP, 0.0)
        tip = arc(np.array(max(k - late, 0) * STEP / (1.0 + slip)))
        tip[2] -= bump if k > 25 else 0.0
        estimator.correct(tip + rng.uniform(-STEP, STEP, 3), age=min(age, k * STEP))
    return "; ".join(estimator.estimate().doubts)


@pytest.mark.parametrize("late", [3, 5])
def test_late_tips_that_nobody_told_of_are_doubted(late: int) -> None:
    assert "late" in doubts(late=late)


def test_late_tips_that_are_told_to_be_late_are_not() -> None:
    assert not doubts(late=3, age=3 * STEP)


@pytest.mark.parametrize("other", [{}, {"slip": 0.05}, {"slip": -0.05}, {"bump": 0.003}])
def test_what_is_not_late_is_not_called_so(other: dict[str, float]) -> None:
    assert "late" not in doubts(**other)  # type: ignore[arg-type]


def test_it_is_what_is_missing_whatever_the_frame() -> None:
    rng = np.random.default_rng(3)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = turn, [0.01, -0.02, 0.03]
    seen = Shortfall(np.zeros((2, 3)))
    for k in range(1, 31):
        seen.advance(np.full(2, STEP))
        tips = arc(np.array([max(k - 3, 0), k]) * STEP)
        if k > 10:
            tips = tips @ turn.T + transform[:3, 3]
        elif k == 10:
            seen.see(tips, np.zeros(2))
            seen.change_frame(transform)
            continue
        seen.see(tips, np.zeros(2))
    np.testing.assert_allclose(seen.mean(), [0.003, 0.0], atol=2e-5)


def test_nothing_is_said_without_a_start_or_without_tips() -> None:
    seen = Shortfall(np.array([[np.nan] * 3, [0.0] * 3]))
    for _ in range(round(LAST / STEP)):
        seen.advance(np.full(2, STEP))
        seen.see(np.array([[0.0] * 3, [np.nan] * 3]), np.zeros(2))
    np.testing.assert_array_equal(seen.mean(), 0.0)
    assert FIRST < LAST
