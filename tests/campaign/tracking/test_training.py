"""A short training on a user's own recording: about two minutes."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from needle_sim.sequences.render_images import main as render_images

ROOT = Path(__file__).parents[3]
TRAINING = ROOT / "scripts/lib/training"
WEIGHTS = ROOT / "ros2_ws/src/needle_tracker/needle_tracker/detector/needle_net.onnx"


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Return a folder with images of an insertion with a needle, and of one without."""
    folder = tmp_path / "recording"
    insertion = ["--start-mm", "20", "--depth-mm", "60", "--step-mm", "2"]
    for name, steps in (("needle", insertion), ("empty", ["--depth-mm", "1", "--step-mm", "0.1"])):
        words = ["--output", str(folder / name), "--scenario", "steel", "--seed", "3", *steps]
        assert render_images(words) == 0
    shutil.copy(folder / "needle/calibration.yaml", folder)
    return folder


def trained(tmp_path: Path, *words: str) -> str:
    """Run the training; return its output."""
    folders = ["--folder", str(tmp_path / "run"), "--output", str(tmp_path / "net.onnx")]
    done = subprocess.run(
        [sys.executable, str(TRAINING / "train_needle_map.py"), *words, *folders],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_training_continues_from_weights_or_a_checkpoint(tmp_path: Path, recording: Path) -> None:
    pytest.importorskip("torch", reason="PyTorch is an extra: docs/dependencies.md")
    pytest.importorskip("onnx", reason="ONNX is an extra: docs/dependencies.md")
    output = tmp_path / "net.onnx"
    shutil.copy(WEIGHTS, output)
    before = output.read_bytes()
    log_text = trained(tmp_path, "--own", str(recording), "--drawn", "2", "--steps", "40")
    assert "tips of 21 pairs say where the needle was" in log_text
    assert log_text.count("whole images of such scenes") == 2, "before and after"
    assert output.read_bytes() != before
    with np.load(tmp_path / "run/scenes/9.npz") as held_out:
        ends = held_out["ends"]
    assert np.isfinite(ends[-2:]).all()
    assert not np.isfinite(ends[:2]).any()
    checkpoint = (tmp_path / "run/checkpoint.pt").read_bytes()
    trained(tmp_path, "--resume", "--scenes", "0", "--drawn", "2", "--steps", "60")
    assert (tmp_path / "run/checkpoint.pt").read_bytes() != checkpoint
