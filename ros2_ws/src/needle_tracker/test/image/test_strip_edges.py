"""A needle's edges in a strip that the test writes itself, columns half a pixel apart."""

from __future__ import annotations

import numpy as np
import pytest

from needle_tracker.image.strip import STEP_PX
from needle_tracker.image.strip_edges import edges_middle

WIDTH, ROWS, REACH = 4.6, 9, 20
ACROSS = STEP_PX * np.arange(-REACH, REACH + 1)


def edge(place: float, blur: float = 0.8) -> np.ndarray:
    return np.asarray(1.0 / (1.0 + np.exp(-(ACROSS - place) / (0.5 * blur))))


def middle(darkness: np.ndarray) -> float:
    strip = np.repeat(100.0 * darkness[None, :], ROWS, axis=0)
    level, steep = np.empty(len(ACROSS)), np.empty(len(ACROSS))
    return edges_middle(strip, ROWS // 2, ROWS - 1, WIDTH, 100.0, level, steep)


NEEDLE = edge(0.3 - 0.5 * WIDTH) - edge(0.3 + 0.5 * WIDTH)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_shadow_beside_the_needle_leaves_its_middle(side: int) -> None:
    beside = 0.5 * (edge(0.3 + 3.5 * side - 2.5, 3.0) - edge(0.3 + 3.5 * side + 2.5, 3.0))
    assert middle(np.maximum(NEEDLE, beside)) == pytest.approx(0.3, abs=0.25)


def test_with_nothing_beside_it_edges_say_nothing() -> None:
    # Shaded from one side to the other.
    assert np.isnan(middle(NEEDLE * (1.0 - 0.15 * (ACROSS - 0.3))))
    assert np.isnan(middle(NEEDLE))
    assert np.isnan(middle(np.zeros(len(ACROSS))))
