"""The end in a needle map: where the chance to reach so far falls, and how fast."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm

from needle_tracker.image.end_fit import _make_survival, fit_end, hidden_sigma

SHAPE = (80, 160)
WIDTH = 5.0
END = np.array([97.3, 41.6])


def drawn(angle: float, sigma: float = 0.4, end: NDArray[np.float64] = END) -> NDArray[np.uint8]:
    """Draw a map of a straight needle whose end is normally distributed along it."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    along = math.cos(angle) * (u - end[0]) + math.sin(angle) * (v - end[1])
    across = -math.sin(angle) * (u - end[0]) + math.cos(angle) * (v - end[1])
    chance = norm.sf(along / sigma) * np.clip(0.5 * WIDTH + 0.5 - np.abs(across), 0.0, 1.0)
    return np.asarray(np.rint(255.0 * chance), np.uint8)


def fitted(
    needle_map: NDArray[np.uint8], angle: float, search: float = 0.0
) -> NDArray[np.float64] | None:
    result = np.zeros(9)
    expected = END + np.array([3.0, 0.0])
    direction = np.array([math.cos(angle + 0.03), math.sin(angle + 0.03)])
    there = fit_end(needle_map, expected, direction, 60.0, search, WIDTH, result)
    return result if there else None


@pytest.mark.parametrize("angle", [-0.4, 0.0, 0.2])
def test_the_end_of_a_sure_map_is_found(angle: float) -> None:
    result = fitted(drawn(angle), angle)
    assert result is not None
    assert result[:2] == pytest.approx(END, abs=0.15)
    assert math.atan2(result[3], result[2]) == pytest.approx(angle, abs=0.01)
    assert result[4] < 0.1
    assert result[7] > 0.95
    assert result[8] > 0.9


@pytest.mark.parametrize("sigma", [1.5, 3.0, 5.0])
def test_an_end_is_as_uncertain_as_the_map_says(sigma: float) -> None:
    result = fitted(drawn(0.1, sigma), 0.1)
    assert result is not None
    assert result[5] == pytest.approx(sigma, rel=0.2)
    assert np.linalg.norm(result[:2] - END) < 0.3 * sigma


def test_an_end_that_a_known_face_hides_is_as_uncertain_as_both_say_together() -> None:
    sigma, face = 0.45, 1.2
    # What the map says times what the face's length says, as one distribution.
    places = np.linspace(-4.0, 4.0, 8001)
    chance = norm.pdf(places, scale=sigma) * norm.pdf(places, scale=face / math.sqrt(12.0))
    together = math.sqrt((chance * places**2).sum() / chance.sum())
    assert hidden_sigma(sigma, face) == pytest.approx(together, rel=1e-6)
    assert hidden_sigma(sigma, 0.0) == sigma
    assert hidden_sigma(sigma, 100.0 * sigma) == pytest.approx(sigma, rel=1e-2)
    assert hidden_sigma(100.0 * face, face) == pytest.approx(face / math.sqrt(12.0), rel=1e-3)


def test_a_line_beside_where_it_should_be_is_found_within_the_search_only() -> None:
    beside = drawn(0.0, end=END + np.array([0.0, 9.0]))
    near, far = fitted(beside, 0.0), fitted(beside, 0.0, search=12.0)
    assert near is None or abs(near[1] - END[1] - 9.0) > 3.0
    assert far is not None
    assert far[1] == pytest.approx(END[1] + 9.0, abs=0.3)


def test_where_there_is_no_needle_there_is_no_line() -> None:
    assert fitted(np.zeros(SHAPE, np.uint8), 0.0, search=10.0) is None


def test_a_needle_that_goes_on_has_no_end_inside() -> None:
    result = fitted(drawn(0.0, end=np.array([400.0, END[1]])), 0.0)
    assert result is not None
    assert result[8] < 0.1


def test_a_needle_reaches_what_is_joined_to_it_and_not_what_lies_beyond_a_gap() -> None:
    chance = np.array([0.9, 0.6, 0.95, 0.1, 0.2, 0.8, 0.4, 0.1, 0.1, 0.1, 0.9])
    _make_survival(chance, 3)
    assert chance.tolist() == [0.95, 0.95, 0.95, 0.8, 0.8, 0.8, 0.4, 0.1, 0.1, 0.0, 0.0]


def test_what_shines_beyond_the_end_is_not_the_needle() -> None:
    image = drawn(0.0)
    image[:, round(END[0]) + 10 : round(END[0]) + 18] = 255
    result = fitted(image, 0.0)
    assert result is not None
    assert result[0] == pytest.approx(END[0], abs=0.3)


def test_a_bevel_reaches_as_far_as_its_farthest_side() -> None:
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    across = v - END[1]
    # Ground from its upper edge, which ends a width earlier, to the extreme point below the axis.
    end = END[0] - WIDTH * np.clip(0.3 - across / WIDTH, 0.0, 1.0)
    chance = norm.sf((u - end) / 0.4) * np.clip(0.5 * WIDTH + 0.5 - np.abs(across), 0.0, 1.0)
    result = fitted(np.asarray(np.rint(255.0 * chance), np.uint8), 0.0)
    assert result is not None
    assert result[0] == pytest.approx(END[0], abs=0.3)


@pytest.mark.parametrize("beside", [-3.0, 3.0])
@pytest.mark.parametrize("also", [-1.0, 0.8])
def test_a_line_that_is_not_as_wide_as_the_needle_may_be_beside_it(
    also: float, beside: float
) -> None:
    """One side of the needle is not shown (-1), or a shadow along it is shown as well."""
    needle, other = drawn(0.0), drawn(0.0, end=END + np.array([0.0, beside]))
    both = np.where(other > 0, 0, needle) if also < 0.0 else np.maximum(needle, also * other)
    result = fitted(both.astype(np.uint8), 0.0)
    alone = fitted(needle, 0.0)
    assert result is not None
    assert alone is not None
    off = abs(result[1] - END[1])
    assert off > 0.6
    assert off < 2.0 * result[4]
    assert alone[4] < 0.1
