"""Patches cut from scenes, and scenes that are traced where Mitsuba is there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from needle_common.errors import UserError
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_sim.path_traced.tracer import load_mitsuba
from needle_verification.training.patches import SIZE
from needle_verification.training.traced_patches import BORDER, traced_patch
from needle_verification.training.traced_scenes import TracedScene, trace_scene

CALIBRATION = Path(__file__).parents[3] / "needle_tracker" / "config" / "calibration.yaml"


def bar(width_px: float) -> TracedScene:
    """Return a scene with a bright bar for a needle; its image is its share."""
    shares = np.zeros((1, 300, 400), np.uint8)
    half = round(0.5 * width_px)
    shares[0, 150 - half : 150 + half, :250] = 255
    return TracedScene(shares.copy(), shares, np.array([[249.5, 149.5]]), width_px)


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


def test_a_traced_scene_says_where_its_shaft_is() -> None:
    pytest.importorskip("mitsuba", reason="Mitsuba is an extra: docs/dependencies.md")
    try:
        mitsuba = load_mitsuba()
    except UserError as error:
        pytest.skip(str(error))
    scene = trace_scene(mitsuba, load_stereo_rig(CALIBRATION), 20001, 4.6)
    assert scene.images.shape == scene.shares.shape
    for share, (u, v) in zip(scene.shares, scene.ends, strict=True):
        across = share[:, round(u) - 40].astype(float).sum() / 255.0
        assert across == pytest.approx(scene.width_px, rel=0.25)
        assert share[round(v) - 3 : round(v) + 4, round(u) + 4 :].max() == 0
