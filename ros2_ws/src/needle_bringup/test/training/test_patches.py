"""Patches to train on, drawn or cut from scenes: what is wanted of them is what they show."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from needle_bringup.training import traced_scenes
from needle_bringup.training.floors import clutter, floor
from needle_bringup.training.needle_ends import Pose, draw_needle, draw_shadow, true_map
from needle_bringup.training.patches import SIZE, patch
from needle_bringup.training.traced_patches import BORDER, new_part, traced_patch
from needle_bringup.training.traced_scenes import TracedScene, shaft_share, trace_scene
from needle_core.files.installed import find_shared
from needle_sim.camera.projection import project
from needle_sim.camera.stereo_rig import load_stereo_rig

RIG = load_stereo_rig(find_shared("needle_tracker", "config/calibration_top_and_side.yaml"))


def test_the_map_is_cut_straight_where_the_axis_ends() -> None:
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


def test_floors_differ_and_are_never_black() -> None:
    floors = [floor(np.random.default_rng(i), SIZE) for i in range(30)]
    assert min(each.min() for each in floors) >= 2.0
    assert max(each.max() for each in floors) <= 255.0
    assert np.std([each.mean() for each in floors]) > 30.0


def test_clutter_lies_over_a_part_of_most_images_and_over_none_of_some() -> None:
    ground = np.full((SIZE, SIZE), 120.0, np.float32)
    seen = [clutter(np.random.default_rng(i), ground) for i in range(30)]
    covered = np.array([np.mean(np.abs(each - ground) > 1.0) for each in seen])
    assert 0.5 < np.mean(covered > 0.0) < 1.0
    assert covered.max() < 0.5


def test_patches_repeat_by_their_seed() -> None:
    one, again, other = (patch(np.random.default_rng([1, n])) for n in (2, 2, 3))
    assert np.array_equal(one[0], again[0])
    assert np.array_equal(one[1], again[1])
    assert not np.array_equal(one[0], other[0])
    # Some of many have a needle, some none.
    shares = [patch(np.random.default_rng([3, n]))[1].any() for n in range(6)]
    assert any(shares)
    assert not all(shares)


def bar(width_px: float) -> TracedScene:
    """Return a scene with a bright bar for a needle; its image is its share."""
    shares = np.zeros((1, 300, 400), np.uint8)
    half = round(0.5 * width_px)
    shares[0, 150 - half : 150 + half, :250] = 255
    return TracedScene(shares.copy(), shares, np.array([[249.5, 149.5]]), np.array([width_px]))


def test_a_patch_of_a_scene_is_turned_and_scaled_with_what_is_wanted_of_it() -> None:
    widths = []
    for width_px in (4.0, 12.0):
        scene = bar(width_px)
        for seed in range(40):
            image, share = traced_patch(np.random.default_rng(seed), scene)
            assert image.shape == (SIZE + 2 * BORDER,) * 2
            middle = image[BORDER:-BORDER, BORDER:-BORDER]
            # Exposed anew it is still bright where needle is, and dark where none is.
            if (share > 0.95).any():
                assert middle[share > 0.95].mean() > 150
            if (share < 0.01).mean() > 0.5:
                assert middle[share < 0.01].mean() < 40
            if share.sum() > 300.0:
                # A bar's area over its length, which is that of its two long edges by half.
                edges = np.abs(np.diff(share, axis=0)).sum() + np.abs(np.diff(share, axis=1)).sum()
                widths.append(share.sum() / (0.5 * edges))
    # About as wide as the net knows them.
    assert 2.5 < np.median(widths) < 6.5


def test_what_has_come_since_an_earlier_image_is_a_needle_of_its_own() -> None:
    shares = np.zeros((3, 300, 400), np.uint8)
    shares[0, 148:152, :190] = shares[2, 148:152, :250] = 255
    ground = np.random.default_rng(5).integers(60, 200, shares.shape[1:]).astype(np.uint8)
    images = np.where(shares > 0, np.uint8(20), ground)
    scene = TracedScene(images, shares, np.full((3, 2), np.nan), np.full(3, 4.0))
    difference, share = new_part(scene, 2, 0)
    assert not share[:, :190].any()
    assert (share[148:152, 190:250] == 255).all()
    # What is not new, floor or needle, is level.
    assert np.abs(difference[share == 0].astype(int) - 128).max() < 5
    assert difference[share > 0].mean() < 60


def test_both_cameras_see_a_shaft_as_wide_as_it_is_whichever_way_they_look() -> None:
    line = np.linspace([0.0, 0.0, 0.001], [0.003, -0.004, 0.06], 200)
    ahead = (line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0])
    # Points of its surface all around the end: the farthest ones across the line are its edges.
    angle = np.linspace(0.0, 2.0 * np.pi, 400)[:, None]
    one = np.cross(ahead, [1.0, 0.0, 0.0])
    one /= np.linalg.norm(one)
    ring = line[-1] + 0.5e-3 * (np.cos(angle) * one + np.sin(angle) * np.cross(ahead, one))
    for camera in (RIG.left, RIG.right):
        share, end, width = shaft_share(line, 1e-3, camera)
        before, last = project(line[-2:], camera)
        along = (last - before) / np.linalg.norm(last - before)
        edges = (project(ring, camera) - last) @ [-along[1], along[0]]
        assert width == pytest.approx(np.ptp(edges), rel=0.1)
        length = np.linalg.norm(np.diff(project(line, camera), axis=0), axis=1).sum()
        assert share.sum(dtype=float) / 255.0 == pytest.approx(width * length, rel=0.05)
        np.testing.assert_allclose(end, last)


def test_a_scene_is_the_empty_phantom_then_a_needle_in_both_cameras(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    images = [
        np.zeros((camera.image_height, camera.image_width), np.uint8)
        for camera in (RIG.left, RIG.right)
    ]
    line = np.linspace([0.0, 0.0, -0.01], [0.003, -0.004, 0.06], 200)
    meshes = [SimpleNamespace(line=line)] * 2
    asked: dict[str, Any] = {}

    def trace(*_: object, **words: Any) -> list[SimpleNamespace]:
        asked.update(words)
        pairs = (None, meshes, meshes)
        return [SimpleNamespace(images=images, meshes=pair) for pair in pairs]

    monkeypatch.setattr(traced_scenes, "trace_insertion", trace)
    scene = trace_scene(SimpleNamespace(), RIG, 3)  # type: ignore[arg-type]
    assert asked["depth"] == pytest.approx(asked["begin"] + asked["step"] * (asked["frames"] - 1))
    assert not scene.shares[:2].any()
    assert np.isnan(scene.ends[:2]).all()
    assert scene.shares[2:].any(axis=(1, 2)).all()
    # Where it will be in the empty phantom it is as wide as in the first pair.
    np.testing.assert_array_equal(scene.widths_px[:2], scene.widths_px[2:4])
