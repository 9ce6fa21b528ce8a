"""Detection of correlated residuals along an arc."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.random import Generator, default_rng

from needle_controller.curvature.curvature_checks import (
    check_independent_residuals,
    fit_checked,
    neighbour_correlation,
)
from needle_controller.curvature.curvature_fit import CurvatureFitSettings
from needle_controller.model.arrays import Array
from needle_core.errors import UserError

from .insertions import insertion_tips

REPEATING = 2e-5
TRACKER = 3e-5  # standard deviation of stereo_tracker's tips [m]


def noise(shape: tuple[int, ...], size: float | None, rng: Generator) -> Array:
    """Return normal noise; None: uniform noise of +-1 mm."""
    if size is None:
        return np.asarray(rng.uniform(-1e-3, 1e-3, shape))
    return np.asarray(rng.normal(0.0, size, shape))


def refused(tips: Array, insertion: Array | None) -> int:
    settings = CurvatureFitSettings(repeating_error=REPEATING)
    count = 0
    for each in tips:
        try:
            check_independent_residuals(fit_checked(each, insertion, settings).residuals, REPEATING)
        except UserError:
            count += 1
    return count


@pytest.mark.parametrize(
    ("size", "known"), [(None, True), (None, False), (TRACKER, True), (2e-4, True)]
)
def test_pure_insertions_are_accepted(size: float | None, known: bool) -> None:
    rng = default_rng(5)
    tips, insertion = insertion_tips(20, 0.06, rng)
    tips = tips + noise(tips.shape, size, rng)
    assert refused(tips, insertion if known else None) == 0


def test_outliers_are_not_correlated_residuals() -> None:
    rng = default_rng(6)
    tips, insertion = insertion_tips(30, 0.06, rng)
    tips = tips + noise(tips.shape, TRACKER, rng)
    # Two consecutive outliers in the same direction.
    tips[:, 20:22] += [5e-3, 0.0, 0.0]
    assert refused(tips, insertion) == 0


def test_repeating_errors_are_tolerated() -> None:
    """All tips are bowed along the arc three times, as by a calibration error."""
    rng = default_rng(7)
    tips, insertion = insertion_tips(1, 0.12, rng)
    bowed = tips[0] + noise(tips[0].shape, 2e-6, rng)
    bowed[:, 1] += REPEATING * np.sin(6.0 * np.pi * insertion / 0.12)
    assert refused(bowed[None], insertion) == 0
    off = fit_checked(bowed, insertion, CurvatureFitSettings()).residuals
    shared, significance = neighbour_correlation(off)
    assert significance > 10.0
    assert 0.3 * REPEATING < shared < REPEATING


@pytest.mark.parametrize(
    ("arc", "size", "degrees"),
    [
        (0.06, TRACKER, 25.0),
        (0.06, TRACKER, 90.0),
        (0.06, TRACKER, 180.0),
        (0.12, TRACKER, 20.0),
        (0.12, TRACKER, 90.0),
        (0.12, None, 45.0),
        (0.12, None, 90.0),
    ],
)
def test_steered_insertions_are_rejected(arc: float, size: float | None, degrees: float) -> None:
    rng = default_rng(8)
    tips, insertion = insertion_tips(10, arc, rng, turn=math.radians(degrees))
    tips = tips + noise(tips.shape, size, rng)
    assert refused(tips, insertion) == 10
    assert refused(tips[:3], None) == 3


def test_the_error_names_a_remedy() -> None:
    misses = np.zeros((60, 3))
    misses[:, 0] = 1e-3 * np.sin(np.linspace(0.0, 2.0 * np.pi, 60))
    with pytest.raises(UserError, match=r"off it, limit 0\.05 mm.*--until-mm.*rotation_rad"):
        check_independent_residuals(misses, REPEATING)
    check_independent_residuals(misses, 1e-3)
    assert neighbour_correlation(np.zeros((8, 3))) == (0.0, 0.0)
