"""The truncated normal without a mathematical library, against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm, truncnorm

from needle_controller.bank.normal_moments import (
    FAR,
    falling_exponential,
    tail_ratio,
    truncated_moments,
)


def test_exponential() -> None:
    x = np.linspace(-16.0, 0.0, 321)
    np.testing.assert_allclose([falling_exponential(v) for v in x], np.exp(x), rtol=3e-11)
    assert falling_exponential(-1000.0) == falling_exponential(-16.0)


def test_tail_ratio() -> None:
    z = np.linspace(0.0, 5.7, 300)
    wanted = norm.sf(z) / np.exp(-0.5 * z * z)
    np.testing.assert_allclose([tail_ratio(v) for v in z], wanted, rtol=1.5e-8)


@pytest.mark.parametrize(
    ("lower", "upper"),
    [(-1, 1), (-0.2, 3), (1, 4), (-4, -1), (3.5, 9), (-9, -3.5), (-8, 8), (-6, 0.5), (4, 4.5)],
)
def test_moments_of_the_truncated_normal(lower: float, upper: float) -> None:
    mass, mean, variance = truncated_moments(float(lower), float(upper))
    reference = truncnorm(lower, upper)
    assert mean == pytest.approx(reference.mean(), abs=1e-4)
    assert variance == pytest.approx(reference.var(), abs=1e-4)
    mirrored = (-upper, -lower) if lower > 0.0 else (lower, upper)
    assert mass == pytest.approx(norm.cdf(mirrored[1]) - norm.cdf(mirrored[0]), rel=1e-3)


def test_bounds_nobody_reaches_leave_the_normal_as_it_is() -> None:
    assert truncated_moments(-FAR, 2.0 * FAR) == (1.0, 0.0, 1.0)


def test_a_normal_far_outside_has_no_mass() -> None:
    for bounds in ((7.0, 9.0), (-9.0, -7.0)):
        mass, mean, variance = truncated_moments(*bounds)
        assert mass == 0.0
        assert np.isfinite([mean, variance]).all()
