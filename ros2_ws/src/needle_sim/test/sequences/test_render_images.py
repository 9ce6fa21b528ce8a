"""Rendered sequences: content of the folder, and one-line errors of bad arguments."""

from __future__ import annotations

import csv
import itertools
import json
import math
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from needle_core.errors import UserError
from needle_sim.camera.image_folder import ImageFolder, truth_of
from needle_sim.camera.insertions import random_path, render_insertion
from needle_sim.camera.scenarios import SCENARIOS
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_sim.needle.needle_shape import NeedleShape
from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.sequences.render_images import main

CALIBRATION = Path(__file__).parents[3] / "needle_tracker" / "config" / "calibration.yaml"
TRACED = ("--renderer", "path_traced")
COORDINATES = ("x_m", "y_m", "z_m", "pitch_rad", "yaw_rad", "shaft_pitch_rad", "shaft_yaw_rad")


def arguments(output: Path, *more: str) -> list[str]:
    return ["--output", str(output), "--calibration", str(CALIBRATION), *more]


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def test_the_folder_contains_the_rendered_images(tmp_path: Path) -> None:
    output, done = tmp_path / "new" / "images", tmp_path / "done.json"
    argv = ["--scenario", "clean", "--frames", "2", "--seed", "7", "--step-mm", "9"]
    assert main(arguments(output, *argv, "--json", str(done))) == 0
    rig, clean = load_stereo_rig(CALIBRATION), SCENARIOS["clean"]
    outside, inside = render_insertion(rig, clean, seed=7, frames=2, step=0.009)
    insertions, truths = rows(output / "insertion.csv"), rows(output / "truth.csv")
    assert [row["name"] for row in insertions] == ["000000.png", "000001.png"]
    assert [float(row["insertion_m"]) for row in insertions] == [0.0, 0.009]
    for side, image in zip(("left", "right"), inside.images, strict=True):
        read = cv2.imread(str(output / side / "000001.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(read, image)
    assert outside.truth is None
    assert all(truths[0][key] == "" for key in COORDINATES)
    truth = inside.truth
    assert truth is not None
    angles = [truth.pitch, truth.yaw, truth.shaft_pitch, truth.shaft_yaw]
    assert [float(truths[1][key]) for key in COORDINATES] == [*truth.tip, *angles]
    assert (float(truths[1]["left_seen"]), float(truths[1]["right_seen"])) == (1.0, 1.0)
    assert (output / "calibration.yaml").read_bytes() == CALIBRATION.read_bytes()
    summary = json.loads(done.read_text())
    assert (summary["scenario"], summary["frames"], summary["seed"]) == ("clean", 2, 7)


def test_random_paths_stay_inside_differ_and_are_smooth() -> None:
    def path_and_tips(seed: int) -> tuple[np.ndarray, np.ndarray]:
        path = random_path(seed, 0.12, (0.0175, math.inf), 1.0 / 0.122)
        plant = NeedlePlant(initial_pose(path.pitch, path.roll), curvature=1.0 / 0.122)
        tips = []
        for rotation in path.rotation:
            plant.advance(0.001, rotation)
            tips.append(plant.T_rig_tip[:3, 3])
        return np.asarray(path.rotation), np.array(tips)

    paths = [path_and_tips(seed) for seed in range(3)]
    for rotation, tips in paths:
        assert np.abs(tips[:, 0]).max() < 0.0136
        assert np.abs(tips[:, 1]).max() < 0.026
        assert np.abs(np.diff(rotation)).max() < np.deg2rad(15.0)
    for (_, one), (_, other) in itertools.combinations(paths, 2):
        assert np.linalg.norm(one[-1] - other[-1]) > 1e-4
    np.testing.assert_array_equal(path_and_tips(2)[0], paths[2][0])


def test_angles_of_the_truth_give_the_directions_back() -> None:
    plant = NeedlePlant(initial_pose(0.3, 0.8), curvature=8.2)
    plant.advance(0.06, 0.5)
    pose = plant.T_rig_tip
    truth = truth_of(pose)

    def direction(pitch: float, yaw: float) -> list[float]:
        return [np.sin(pitch), -np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch)]

    np.testing.assert_allclose(direction(truth.pitch, truth.yaw), pose[:3, 2], atol=1e-12)
    line = NeedleShape().shaft_centreline(pose, plant.centreline(0.001), 0.0003)
    # The path itself bends a little under the shaft's last 0.3 mm.
    end = (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
    np.testing.assert_allclose(direction(truth.shaft_pitch, truth.shaft_yaw), end, atol=0.006)
    np.testing.assert_array_equal(truth.tip, pose[:3, 3])


@pytest.mark.parametrize(
    ("argv", "named"),
    [
        (["--scenario", "fog"], "scenario 'fog' is not one of clean"),
        (["--frames", "0"], "--frames = 0 is outside [1, 999999]"),
        (["--calibration", "/nowhere.yaml"], "/nowhere.yaml: cannot be read: No such file"),
        (["--start-mm", "130"], "--start-mm = 130 mm is outside [0, 120]"),
        (["--appearance", "random"], "--appearance is for renderer path_traced"),
        ([*TRACED, "--scenario", "clean"], "--scenario is for renderer quick"),
        ([*TRACED, "--appearance", "fog"], "appearance 'fog' is not one of random"),
        # No Mitsuba.
        (TRACED, "renderer path_traced needs Mitsuba 3, which is not installed"),
        (["--json", "/nowhere/done.json"], "--json /nowhere/done.json"),
    ],
)
def test_a_bad_argument_is_one_line_and_writes_nothing(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    argv: list[str],
    named: str,
) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    assert main(arguments(tmp_path / "out", *argv)) == 2
    error = capsys.readouterr().err
    assert named in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_folder_in_use_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "kept.txt").write_text("mine")
    assert main(arguments(tmp_path, "--frames", "1")) == 2
    assert "is not empty" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["kept.txt"]
    assert main(["--frames", "1"]) == 2
    assert "--output" in capsys.readouterr().err
    with pytest.raises(UserError, match="cannot write"):
        ImageFolder(tmp_path / "kept.txt" / "below", CALIBRATION)
