"""Detection of correlated residuals along an arc."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.random import default_rng

from needle_controller.curvature.curvature_checks import (
    check_independent_residuals,
    fit_checked,
    neighbour_correlation,
)
from needle_controller.curvature.curvature_fit import CurvatureFitSettings
from needle_controller.model.arrays import Array
from needle_core.errors import UserError

from .insertions import insertion_tips, uniform

REPEATING = 2e-5
TRACKER = 3e-5  # standard deviation of stereo_tracker's tips [m]


def refused(tips: Array, insertion: Array | None) -> int:
    settings = CurvatureFitSettings(repeating_error=REPEATING)
    count = 0
    for each in tips:
        try:
            check_independent_residuals(fit_checked(each, insertion, settings).residuals, REPEATING)
        except UserError:
            count += 1
    return count


@pytest.mark.parametrize("has_outliers", [False, True])
def test_pure_insertions_are_accepted(has_outliers: bool) -> None:
    rng = default_rng(5)
    tips, insertion = insertion_tips(20, 0.06, rng)
    tips = tips + rng.normal(0.0, TRACKER, tips.shape)
    if has_outliers:
        # Two consecutive ones in the same direction.
        tips[:, 20:22] += [5e-3, 0.0, 0.0]
    assert refused(tips, insertion) == refused(uniform(tips, rng), None) == 0


def test_repeating_errors_are_tolerated() -> None:
    """All tips are bowed along the arc three times, as by a calibration error."""
    rng = default_rng(7)
    tips, insertion = insertion_tips(1, 0.12, rng)
    bowed = tips[0] + rng.normal(0.0, 2e-6, tips[0].shape)
    bowed[:, 1] += REPEATING * np.sin(6.0 * np.pi * insertion / 0.12)
    assert refused(bowed[None], insertion) == 0
    off = fit_checked(bowed, insertion, CurvatureFitSettings()).residuals
    shared, significance = neighbour_correlation(off)
    assert significance > 10.0
    assert 0.3 * REPEATING < shared < REPEATING


@pytest.mark.parametrize("degrees", [25.0, 90.0, 180.0])
def test_steered_insertions_are_rejected(degrees: float) -> None:
    rng = default_rng(8)
    tips, insertion = insertion_tips(10, 0.06, rng, turn=math.radians(degrees))
    tips = tips + rng.normal(0.0, TRACKER, tips.shape)
    assert refused(tips, insertion) == 10
    assert refused(tips[:3], None) == 3


def test_a_long_steered_insertion_is_rejected_despite_noise() -> None:
    rng = default_rng(8)
    tips, insertion = insertion_tips(10, 0.12, rng, turn=math.radians(45.0))
    assert refused(uniform(tips, rng), insertion) == 10


def test_residuals_of_exact_tips_are_not_correlated() -> None:
    assert neighbour_correlation(np.zeros((8, 3))) == (0.0, 0.0)
