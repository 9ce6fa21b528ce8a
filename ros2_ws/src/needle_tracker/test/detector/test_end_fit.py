"""Line and end fitted to maps of known truth: position and uncertainty."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import norm

from needle_tracker.detector.end_fit import ImageEnd, fit_end

SHAPE = (100, 180)
WIDTH = 5.0
END = np.array([97.3, 46.6])


def maps(
    angle: float, sigma: float, *, known: float = 0.95, end: np.ndarray = END
) -> tuple[np.ndarray, np.ndarray]:
    """Draw a straight shaft, and a normal density of its end."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    along = math.cos(angle) * (u - end[0]) + math.sin(angle) * (v - end[1])
    across = -math.sin(angle) * (u - end[0]) + math.cos(angle) * (v - end[1])
    shaft = norm.sf(along / max(sigma, 0.4)) * np.clip(0.5 * WIDTH + 0.5 - np.abs(across), 0.0, 1.0)
    ends = known * norm.pdf(along, scale=sigma) * norm.pdf(across, scale=0.7)
    return shaft.astype(np.float32), ends.astype(np.float32)


def fitted(
    drawn: tuple[np.ndarray, np.ndarray], angle: float, across: float = 4.0, *, lone: bool = False
) -> ImageEnd | None:
    """Fit from a position that is 3 px off and a direction that is 0.03 rad off."""
    direction = np.array([math.cos(angle + 0.03), math.sin(angle + 0.03)])
    place = END + np.array([3.0, 0.0])
    return fit_end(
        *drawn,
        place,
        direction,
        shaft_length=60.0,
        along=15.0,
        across=across,
        width=WIDTH,
        lone=lone,
    )


@pytest.mark.parametrize("angle", [-2.5, -0.4, 0.0, 0.2, 1.3])
def test_line_and_end_are_found(angle: float) -> None:
    end = fitted(maps(angle, 0.8), angle)
    assert end is not None
    np.testing.assert_allclose(end.point, END, atol=0.15)
    assert math.remainder(
        math.atan2(end.direction[1], end.direction[0]) - angle, 2.0 * math.pi
    ) == pytest.approx(0.0, abs=0.005)
    assert end.sigma_across < 0.6
    assert end.ends == pytest.approx(0.95, abs=0.05)
    assert end.shaft > 0.9


@pytest.mark.parametrize("sigma", [1.0, 2.0, 4.0])
def test_an_end_is_as_uncertain_as_its_density_says(sigma: float) -> None:
    end = fitted(maps(0.1, sigma), 0.1)
    assert end is not None
    assert end.sigma_along == pytest.approx(math.hypot(sigma, 0.5), rel=0.2)


def test_an_end_that_the_map_does_not_show_may_be_anywhere_in_the_window() -> None:
    shaft, ends = maps(0.1, 1.0)
    end = fitted((shaft, 1e-6 * ends), 0.1)
    assert end is not None
    # The middle 68 % of a uniform density over 30 px are 20 px.
    assert end.sigma_along == pytest.approx(10.0, abs=1.5)
    assert end.ends < 1e-3
    assert end.sigma_across < 0.6, "its line is seen as well as ever"


def test_a_needle_away_from_the_expected_place_is_found_within_the_search() -> None:
    beside = END + np.array([0.0, 9.0])
    drawn = maps(0.0, 0.8, end=beside)
    end = fitted(drawn, 0.0, across=12.0)
    assert end is not None
    np.testing.assert_allclose(end.point, beside, atol=0.2)


def test_without_a_shaft_only_an_end_that_the_map_shows_counts() -> None:
    shaft, ends = maps(0.0, 0.8)
    assert fitted((0.0 * shaft, ends), 0.0) is None
    end = fitted((0.0 * shaft, ends), 0.0, lone=True)
    assert end is not None
    assert end.ends > 0.9
    assert end.shaft == 0.0
    np.testing.assert_allclose(end.direction, [math.cos(0.03), math.sin(0.03)])
    assert end.sigma_across == end.sigma_along == pytest.approx(0.5 * WIDTH)
