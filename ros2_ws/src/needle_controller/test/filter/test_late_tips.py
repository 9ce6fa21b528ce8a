"""Detection of late tips, and of effects that resemble them."""

from __future__ import annotations

import numpy as np
import pytest

from needle_controller.filter.filter_settings import FilterSettings
from needle_controller.filter.late_tips import FIRST, hidden_age
from needle_controller.many_needles import ManyFilters
from needle_controller.model.arrays import Array

STEP = 0.001
RADIUS = 0.122
NEEDLES, STEPS = 20, 40
KNOWN = (0.0005, 0.001)
"""Entry, bound of the noise [m]."""


def arc(inserted: Array | float) -> Array:
    """Return tips of a needle that bends, (..., 3) [m]."""
    angle = np.asarray(inserted) / RADIUS
    x = RADIUS * (1.0 - np.cos(angle))
    return np.stack([x, np.zeros_like(x), RADIUS * np.sin(angle)], axis=-1)


def inserted_needles(
    late: float = 0, age: float = 0.0, slip: float = 0.0, bump: float = 0.0, outliers: float = 0.0
) -> ManyFilters:
    """Return twenty filters after a pure insertion with +-1 mm noise."""
    rng = np.random.default_rng(7)
    filters = ManyFilters(FilterSettings(), NEEDLES, STEP)
    filters.start(rng.uniform(-STEP, STEP, (NEEDLES, 3)))
    for k in range(1, STEPS + 1):
        filters.advance(np.full(NEEDLES, STEP), np.zeros(NEEDLES))
        tips = arc(max(k - late, 0) * STEP / (1.0 + slip)) + rng.uniform(-STEP, STEP, (NEEDLES, 3))
        tips[:, 2] -= bump if k > 25 else 0.0
        off = np.where(rng.random(NEEDLES) < outliers, 0.005, 0.0)[:, None]
        tips += off * rng.uniform(-1.0, 1.0, (NEEDLES, 3))
        filters.correct(tips, None, np.full(NEEDLES, min(age, k * STEP)))
    return filters


def called_late(filters: ManyFilters) -> Array:
    return np.asarray(filters.needles["late"] > 0.0)


@pytest.mark.parametrize("late", [3, 5])
def test_late_tips_are_detected_and_reported(late: int) -> None:
    filters = inserted_needles(late=late)
    np.testing.assert_array_equal(called_late(filters), 1)
    # The estimate is at the present position.
    off = filters.estimates["coordinates"][:, 2] - arc(STEPS * STEP)[2]
    assert np.sqrt(np.mean(off**2)) < 0.6 * STEP


def test_stated_ages_are_not_detected_as_late() -> None:
    assert not np.any(called_late(inserted_needles(late=3, age=3 * STEP)))


@pytest.mark.parametrize(
    ("name", "size"), [("slip", 0.1), ("slip", -0.05), ("bump", 0.003), ("outliers", 0.1)]
)
def test_other_disturbances_are_not_detected_as_late(name: str, size: float) -> None:
    assert not np.any(called_late(inserted_needles(**{name: size})))


def exact_tips(late: float) -> tuple[Array, Array]:
    """Return insertions and shifts of exact tips."""
    inserted = np.arange(1, 21, dtype=np.float64) * STEP
    return inserted, arc(np.maximum(inserted - late, 0.0))


def test_a_first_tip_that_was_too_deep_is_not_an_age() -> None:
    inserted, shifts = exact_tips(0.0)
    shifts[:, 2] -= 0.0022
    assert hidden_age(inserted, shifts, 0.0, np.inf, *KNOWN[1:]) > 0.0
    assert hidden_age(inserted, shifts, 0.0022, *KNOWN) == 0.0


def test_no_age_is_detected_without_a_start_or_tips() -> None:
    inserted, shifts = exact_tips(0.003)
    few = np.where((inserted < FIRST + 4.5 * STEP)[:, None], shifts, np.nan)
    ages = [
        hidden_age(inserted, w, 0.0, *KNOWN) for w in (few, np.full_like(shifts, np.nan), shifts)
    ]
    np.testing.assert_array_equal(np.array(ages) > 0.0, [True, False, True])
    few[np.argmax(inserted >= FIRST)] = np.nan
    assert hidden_age(inserted, few, 0.0, *KNOWN) == 0.0
