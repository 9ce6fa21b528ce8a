"""Drawn training samples match the request."""

from __future__ import annotations

import numpy as np
import pytest

from needle_bringup.training.needle_ends import (
    Pose,
    draw_needle,
    draw_shadow,
    true_map,
)
from needle_bringup.training.patches import patch
from needle_bringup.training.samples import CANVAS

SIZE = 96


def test_the_map_is_cut_straight_at_the_end_of_the_axis() -> None:
    share = true_map(Pose(60.0, 40.0, 0.0, 0.0, 0.0, 2.5), SIZE)
    assert share.sum() == pytest.approx(5.0 * 60.5, rel=0.02)
    assert share[40, :60].min() == 1.0
    assert share[40, 62:].max() == share[:36].max() == share[45:].max() == 0.0


def test_a_needle_is_drawn_within_its_outline_and_a_shadow_takes_light_away() -> None:
    ground = np.full((SIZE, SIZE), 120.0, np.float32)
    for heading in (0.0, 2.0, -1.0):
        pose = Pose(48.0, 48.0, heading, 1e-3, 0.0, 2.5)
        changed = np.abs(draw_needle(np.random.default_rng(4), ground, pose) - ground) > 1.0
        reach = true_map(pose, SIZE) > 0.0
        assert changed[reach].mean() > 0.5
        assert not changed[~reach].any()
    shaded = draw_shadow(np.random.default_rng(1), ground, pose)
    assert shaded.max() <= 120.0
    assert shaded.min() < 115.0


def test_a_needle_slides_along_its_own_curve() -> None:
    pose = Pose(60.0, 48.0, 0.3, 2e-3, 1e-5, 2.5)
    whole, shorter = (true_map(each, SIZE) for each in (pose, pose.slid(-20.0)))
    assert whole.sum() - shorter.sum() == pytest.approx(20.0 * 5.0, rel=0.05)
    # The remaining part stays in place.
    assert np.maximum(shorter - whole, 0.0).sum() < 0.03 * shorter.sum()
    back = pose.slid(-20.0).slid(20.0)
    assert np.hypot(back.x - pose.x, back.y - pose.y) < 0.5


def test_patches_repeat_by_their_seed() -> None:
    one, again, other = (patch(np.random.default_rng([1, n])) for n in (2, 2, 3))
    assert np.array_equal(one.image, again.image)
    assert np.array_equal(one.share, again.share)
    assert not np.array_equal(one.image, other.image)


def test_patches_have_needles_backgrounds_and_ends_or_none() -> None:
    samples = [patch(np.random.default_rng([3, n])) for n in range(7)]
    for sample in samples:
        assert sample.image.shape == sample.share.shape == (CANVAS, CANVAS)
        # Without a shaft there is no end; a shaft may end outside the patch.
        assert np.isnan(sample.end).all() or sample.share.any() or sample.end.min() < 0.0
        if sample.share.any():
            assert np.isfinite(sample.end).all()
    for some in (
        [sample.share.any() for sample in samples],
        [sample.background is not None for sample in samples],
    ):
        assert any(some)
        assert not all(some)
