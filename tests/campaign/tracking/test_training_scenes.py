"""The stored net on unseen patches, and path-traced scenes for training."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from needle_bringup.training.patches import patch
from needle_bringup.training.samples import SIZE
from needle_bringup.training.traced_scenes import trace_scene
from needle_core.errors import UserError
from needle_core.files.installed import find_shared_file
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_sim.path_traced.tracer import load_mitsuba
from sample_pool import CONTEXT, Batch, batch_of, read_shard, write_shard

UNSEEN = 1_000_000
"""Shard number outside of the training, whose shards are numbered from 0."""
WEIGHTS = (
    Path(__file__).parents[3] / "ros2_ws/src/needle_tracker/needle_tracker/detector/needle_net.onnx"
)
_NEAR_PX = 4.0


@pytest.fixture(scope="module")
def unseen(tmp_path_factory: pytest.TempPathFactory) -> Batch:
    """Return drawn samples as input of the net."""
    path = tmp_path_factory.mktemp("unseen") / "drawn-00000.npz"
    write_shard(path, [0, UNSEEN], patch)
    count = 128
    return batch_of([(read_shard(path), i) for i in range(count)], [0] * count, [False] * count)


def test_the_stored_net_detects_unseen_needles(unseen: Batch) -> None:
    net = cv2.dnn.readNetFromONNX(str(WEIGHTS))
    rows, columns = np.indices((SIZE, SIZE))
    shown, excess, at_ends, without = [], [], [], []
    for inputs, share, end in zip(unseen.inputs, unseen.shares, unseen.ends, strict=True):
        net.setInput(inputs[None])
        shaft, log_intensity = (
            out[0, 0, CONTEXT:-CONTEXT, CONTEXT:-CONTEXT] for out in net.forward(["shaft", "end"])
        )
        intensity = np.exp(log_intensity.astype(float))
        excess.append(float((shaft - share).mean()))
        if share.sum() > 20.0:
            shown.append(float(shaft[share > 0.5].mean()))
        if np.isfinite(end).all():
            at_ends.append(intensity[np.hypot(columns - end[0], rows - end[1]) < _NEAR_PX].sum())
        else:
            without.append(intensity.sum())
    # Many are hardly visible: thin, dark, out of focus, or present in their own background.
    assert np.median(shown) > 0.35
    assert np.median(at_ends) > 0.35
    assert np.mean(without) < 0.4
    # The outputs are calibrated: the mean share of needle is the true one.
    assert abs(np.mean(excess)) < 0.01


def test_a_traced_scene_gives_the_position_of_its_shaft() -> None:
    pytest.importorskip("mitsuba", reason="Mitsuba is an extra: docs/dependencies.md")
    try:
        mitsuba = load_mitsuba()
    except UserError as error:
        pytest.skip(str(error))
    calibration = Path(find_shared_file("needle_tracker", "config/calibration.yaml"))
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
