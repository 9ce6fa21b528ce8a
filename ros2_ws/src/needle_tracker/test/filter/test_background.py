"""Choice of the background pair."""

from __future__ import annotations

import numpy as np
import pytest

from needle_tracker.filter.needle_tracker import Background, Pair

LEAST_NEW = 2e-3


def pair(level: int) -> Pair:
    return np.full((4, 4), level, np.uint8), np.full((4, 4), level + 1, np.uint8)


def shown(background: Background, insertions: list[float | None]) -> list[int | None]:
    """Return the number of the background pair for each pair."""
    pairs = [background.update(pair(i), insertion) for i, insertion in enumerate(insertions)]
    return [None if each is None else int(each[0][0, 0]) for each in pairs]


@pytest.mark.parametrize(
    ("insertions", "expected"),
    [
        ([None, None, None], [None, 0, 0]),
        # Less than 2 mm of new needle is not enough.
        ([0.050, 0.051, 0.053], [None, None, 0]),
        ([0.050, 0.030, 0.040], [None, None, 1]),
        ([0.0, 0.010, -0.001, 0.020], [None, 0, None, 2]),
        # Outside, a newer pair is preferred.
        ([0.0, -0.002, 0.0, 0.050], [None, None, None, 2]),
    ],
)
def test_the_pair_with_the_least_needle_is_the_background(
    insertions: list[float | None], expected: list[int | None]
) -> None:
    assert shown(Background(None, LEAST_NEW), insertions) == expected


def test_a_reference_holds_until_the_needle_is_outside() -> None:
    background = Background(pair(100), LEAST_NEW)
    assert shown(background, [None, 0.04, 0.0, 0.05]) == [100, 100, None, 2]


def test_the_background_is_a_copy() -> None:
    images = pair(7)
    background = Background(images, LEAST_NEW)
    images[0][:] = 99
    kept = background.update(pair(1), None)
    assert kept is not None
    assert kept[0][0, 0] == 7
