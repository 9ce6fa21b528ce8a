"""Drawn training samples match the request."""

from __future__ import annotations

import numpy as np
import pytest

from needle_bringup.training.needle_ends import (
    Pose,
    draw_needle,
    draw_shadow,
    drawn_tracks,
    shifted_tracks,
    true_map,
)
from needle_bringup.training.patches import patch
from needle_bringup.training.samples import CANVAS, moved

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


def test_tracks_without_a_background_are_faint() -> None:
    pose = Pose(88.0, 88.0, 0.0, 0.0, 0.0, 2.5)
    strongest = {True: 0.0, False: 0.0}
    for seed in range(12):
        for faint in (True, False):
            factor = drawn_tracks(np.random.default_rng(seed), pose, CANVAS, faint=faint)
            assert factor.min() > 0.0
            strongest[faint] = max(strongest[faint], float(np.abs(factor - 1.0).max()))
    # Up to three may overlap.
    assert strongest[True] < 1.15**3 - 1.0
    assert strongest[False] > 0.5


def test_gel_moves_tracks_by_three_pixels_at_most() -> None:
    spot = np.ones((CANVAS, CANVAS), np.float32)
    spot[80:90, 80:90] = 0.2
    weight = 1.0 - spot
    for seed in range(10):
        before = 1.0 - shifted_tracks(np.random.default_rng(seed), spot)
        rows, columns = np.indices(spot.shape)
        offset = [
            (before * axis).sum() / before.sum() - (weight * axis).sum() / weight.sum()
            for axis in (rows, columns)
        ]
        assert np.hypot(*offset) < 3.2


def test_an_image_is_shifted_by_the_distance() -> None:
    image = np.zeros((40, 40), np.float32)
    image[20, 20] = 100.0
    there = moved(image, 3.0, 0.0)
    assert there[20, 23] == pytest.approx(100.0)
    assert there[20, 20] == 0.0


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
