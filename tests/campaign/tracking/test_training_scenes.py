"""The stored net on patches that it was not trained on, and path-traced scenes to train on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from needle_bringup.training.patches import SIZE, WIDTH, patch
from needle_bringup.training.traced_scenes import trace_scene
from needle_core.errors import UserError
from needle_core.files.installed import find_shared
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_sim.path_traced.tracer import load_mitsuba
from needle_tracker.image.needle_map import NeedleMap

UNSEEN = 1_000_000
"""Shards are numbered from 0."""


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


def test_a_traced_scene_says_where_its_shaft_is() -> None:
    pytest.importorskip("mitsuba", reason="Mitsuba is an extra: docs/dependencies.md")
    try:
        mitsuba = load_mitsuba()
    except UserError as error:
        pytest.skip(str(error))
    calibration = Path(find_shared("needle_tracker", "config/calibration.yaml"))
    scene = trace_scene(mitsuba, load_stereo_rig(calibration), 20001)
    assert scene.images.shape == scene.shares.shape
    assert not scene.shares[:2].any()
    assert np.isnan(scene.ends[:2]).all()
    for share, (u, v), width in zip(
        scene.shares[2:], scene.ends[2:], scene.widths_px[2:], strict=True
    ):
        across = share[:, round(u) - 40].astype(float).sum() / 255.0
        assert across == pytest.approx(width, rel=0.25)
        assert share[round(v) - 3 : round(v) + 4, round(u) + 4 :].max() == 0
