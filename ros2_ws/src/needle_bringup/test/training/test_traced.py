"""Patches cut from scenes, and scenes that are traced where Mitsuba is there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from needle_bringup.training.patches import SIZE
from needle_bringup.training.traced_patches import BORDER, new_part, traced_patch
from needle_bringup.training.traced_scenes import TracedScene, shaft_share, trace_scene
from needle_core.errors import UserError
from needle_sim.camera.projection import project
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_sim.path_traced.tracer import load_mitsuba

CONFIG = Path(__file__).parents[3] / "needle_tracker" / "config"
CALIBRATION = CONFIG / "calibration.yaml"


def bar(width_px: float) -> TracedScene:
    """Return a scene with a bright bar for a needle; its image is its share."""
    shares = np.zeros((1, 300, 400), np.uint8)
    half = round(0.5 * width_px)
    shares[0, 150 - half : 150 + half, :250] = 255
    return TracedScene(shares.copy(), shares, np.array([[249.5, 149.5]]), np.array([width_px]))


@pytest.mark.parametrize("width_px", [4.0, 12.0])
def test_a_patch_is_turned_and_scaled_with_what_is_wanted_of_it(width_px: float) -> None:
    scene = bar(width_px)
    for seed in range(40):
        image, share = traced_patch(np.random.default_rng(seed), scene)
        assert image.shape == (SIZE + 2 * BORDER,) * 2
        assert share.shape == (SIZE, SIZE)
        middle = image[BORDER:-BORDER, BORDER:-BORDER]
        # Exposed anew it is still bright where needle is, and dark where none is.
        if (share > 0.95).any():
            assert middle[share > 0.95].mean() > 150
        if (share < 0.01).mean() > 0.5:
            assert middle[share < 0.01].mean() < 40


def test_needles_are_about_as_wide_as_the_net_knows_them() -> None:
    scene, widths = bar(12.0), []
    for seed in range(60):
        _, share = traced_patch(np.random.default_rng(seed), scene)
        if share.sum() > 300.0:
            # A bar's area over its length, which is that of its two long edges by half.
            edges = np.abs(np.diff(share, axis=0)).sum() + np.abs(np.diff(share, axis=1)).sum()
            widths.append(share.sum() / (0.5 * edges))
    assert 2.5 < np.median(widths) < 6.5


def test_what_has_come_since_an_earlier_image_is_a_needle_of_its_own() -> None:
    shares = np.zeros((3, 300, 400), np.uint8)
    shares[0, 148:152, :190] = shares[2, 148:152, :250] = 255
    floor = np.random.default_rng(5).integers(60, 200, shares.shape[1:]).astype(np.uint8)
    images = np.where(shares > 0, np.uint8(20), floor)
    scene = TracedScene(images, shares, np.full((3, 2), np.nan), np.full(3, 4.0))
    difference, share = new_part(scene, 2, 0)
    assert not share[:, :190].any()
    assert (share[148:152, 190:250] == 255).all()
    # What is not new, floor or needle, is level.
    assert np.abs(difference[share == 0].astype(int) - 128).max() < 5
    assert difference[share > 0].mean() < 60


def test_both_cameras_see_a_shaft_as_wide_as_it_is_whichever_way_they_look() -> None:
    rig = load_stereo_rig(CONFIG / "calibration_top_and_side.yaml")
    line = np.linspace([0.0, 0.0, 0.001], [0.003, -0.004, 0.06], 200)
    ahead = (line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0])
    # Points of its surface all around the end: the farthest ones across the line are its edges.
    angle = np.linspace(0.0, 2.0 * np.pi, 400)[:, None]
    one = np.cross(ahead, [1.0, 0.0, 0.0])
    one /= np.linalg.norm(one)
    ring = line[-1] + 0.5e-3 * (np.cos(angle) * one + np.sin(angle) * np.cross(ahead, one))
    for camera in (rig.left, rig.right):
        share, end, width = shaft_share(line, 1e-3, camera)
        before, last = project(line[-2:], camera)
        along = (last - before) / np.linalg.norm(last - before)
        edges = (project(ring, camera) - last) @ [-along[1], along[0]]
        assert width == pytest.approx(np.ptp(edges), rel=0.1)
        area = share.sum(dtype=float) / 255.0
        length = np.linalg.norm(np.diff(project(line, camera), axis=0), axis=1).sum()
        assert area == pytest.approx(width * length, rel=0.05)
        np.testing.assert_allclose(end, last)


def test_a_traced_scene_says_where_its_shaft_is() -> None:
    pytest.importorskip("mitsuba", reason="Mitsuba is an extra: docs/dependencies.md")
    try:
        mitsuba = load_mitsuba()
    except UserError as error:
        pytest.skip(str(error))
    scene = trace_scene(mitsuba, load_stereo_rig(CALIBRATION), 20001)
    assert scene.images.shape == scene.shares.shape
    assert not scene.shares[:2].any()
    assert np.isnan(scene.ends[:2]).all()
    for share, (u, v), width in zip(
        scene.shares[2:], scene.ends[2:], scene.widths_px[2:], strict=True
    ):
        across = share[:, round(u) - 40].astype(float).sum() / 255.0
        assert across == pytest.approx(width, rel=0.25)
        assert share[round(v) - 3 : round(v) + 4, round(u) + 4 :].max() == 0
