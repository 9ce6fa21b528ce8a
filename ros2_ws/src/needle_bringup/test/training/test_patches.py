"""Patches to train on, and what the stored net makes of such that it was not trained on."""

import numpy as np
import pytest

from needle_bringup.training.floors import floor
from needle_bringup.training.needle_ends import Pose, draw_needle, draw_shadow, true_map
from needle_bringup.training.patches import SIZE, WIDTH, patch
from needle_tracker.image.needle_map import NeedleMap

UNSEEN = 1_000_000
"""Shards are numbered from 0."""


def test_the_map_is_cut_straight_where_the_axis_ends() -> None:
    pose = Pose(60.0, 40.0, 0.0, 0.0, 0.0, 2.5)
    share = true_map(pose, SIZE)
    assert share.sum() == pytest.approx(5.0 * 60.5, rel=0.02)
    assert share[40, :60].min() == 1.0
    assert share[40, 62:].max() == 0.0
    assert share[:36].max() == share[45:].max() == 0.0


@pytest.mark.parametrize("heading", [0.0, 2.0, -1.0])
def test_a_needle_is_drawn_within_its_outline(heading: float) -> None:
    pose = Pose(48.0, 48.0, heading, 1e-3, 0.0, 2.5)
    ground = np.full((SIZE, SIZE), 120.0, np.float32)
    changed = np.abs(draw_needle(np.random.default_rng(4), ground, pose) - ground) > 1.0
    reach = true_map(pose, SIZE) > 0.0
    assert changed[reach].mean() > 0.5
    assert not changed[~reach].any()


def test_floors_differ_and_are_never_black() -> None:
    floors = [floor(np.random.default_rng(i), SIZE) for i in range(30)]
    assert min(each.min() for each in floors) >= 2.0
    assert max(each.max() for each in floors) <= 255.0
    assert np.std([each.mean() for each in floors]) > 30.0


def test_a_shadow_takes_light_away() -> None:
    pose = Pose(48.0, 48.0, 0.0, 0.0, 0.0, 2.5)
    ground = np.full((SIZE, SIZE), 100.0, np.float32)
    shaded = draw_shadow(np.random.default_rng(1), ground, pose)
    assert shaded.max() <= 100.0
    assert shaded.min() < 95.0


def test_patches_repeat_by_their_seed() -> None:
    one, other = (patch(np.random.default_rng([1, 2])) for _ in range(2))
    assert np.array_equal(one[0], other[0])
    assert np.array_equal(one[1], other[1])
    assert not np.array_equal(one[0], patch(np.random.default_rng([1, 3]))[0])


def test_the_stored_net_shows_needles_that_it_was_not_trained_on() -> None:
    needle_map = NeedleMap(WIDTH)
    found, wanted, false = [], [], []
    for i in range(150):
        image, share = patch(np.random.default_rng([UNSEEN, i]))
        shown = needle_map.draw(image, (0, 0, SIZE, SIZE)) / 255.0
        if share.sum() > 20.0:
            found.append(float(shown[share > 0.5].mean()))
        elif not share.any():
            false.append(float((shown > 0.5).mean()))
        wanted.append(float((shown - share).mean()))
    # Some are hardly to be seen.
    assert np.median(found) > 0.5
    assert np.mean(false) < 0.01
    # Its chances are chances: as much needle is shown as there is.
    assert abs(np.mean(wanted)) < 0.01
