"""Which pair is kept as what stands behind the needle, and for how long."""

from __future__ import annotations

import numpy as np
import pytest

from needle_tracker.image.backgrounds import Backgrounds
from needle_tracker.image.detection import Image
from needle_tracker.optics.refraction import RefractedCamera

Views = tuple[RefractedCamera, RefractedCamera]
Pair = tuple[Image, Image]
CLEARANCE, WIDTH = 2e-3, 0.7e-3
SHAPE = (768, 1024)


def marked(level: int) -> Pair:
    """Return a pair with a bright and dark pattern of a strength of its own."""
    image = np.full(SHAPE, 100, np.uint8)
    image[::3] = 100 + level
    return image, image.copy()


def contents(backgrounds: Backgrounds, insertion: float | None) -> bool:
    """Return whether what is kept was taken without a needle."""
    return backgrounds.see(marked(9), insertion)[0].is_empty


@pytest.mark.parametrize("insertion", [None, 0.060])
def test_the_first_pair_is_kept_until_there_is_less_of_the_needle(
    views: Views, insertion: float | None
) -> None:
    backgrounds = Backgrounds(views, CLEARANCE, WIDTH, None)
    first = backgrounds.see(marked(9), insertion)
    assert not first[0].is_empty
    assert backgrounds.see(marked(30), None) is first
    less = backgrounds.see(marked(30), 0.055)
    assert less is not first
    assert backgrounds.see(marked(9), 0.060) is less
    assert contents(backgrounds, None) is False


def test_a_pair_without_needle_holds_for_all_that_follow(views: Views) -> None:
    backgrounds = Backgrounds(views, CLEARANCE, WIDTH, None)
    assert contents(backgrounds, 0.001) is True
    assert contents(backgrounds, 0.060) is True
    assert contents(backgrounds, None) is True


def test_the_latest_pair_without_needle_counts(views: Views) -> None:
    backgrounds = Backgrounds(views, CLEARANCE, WIDTH, marked(40))
    now = marked(80)
    kept = backgrounds.see(now, 0.06)
    assert kept[0].difference(now[0]) is not None
    backgrounds.see(now, 0.0015)
    kept = backgrounds.see(now, 0.06)
    difference = kept[0].difference(now[0])
    assert difference is not None
    assert float(difference.std()) < 1.0
