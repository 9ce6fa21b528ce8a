"""Rendered sequences: what the folder says is what was rendered; bad arguments are one line."""

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


def test_the_folder_holds_what_was_rendered(tmp_path: Path) -> None:
    output = tmp_path / "new" / "images"
    words = ["--scenario", "clutter", "--frames", "4", "--seed", "7", "--step-mm", "9"]
    assert main(arguments(output, *words, "--json", str(tmp_path / "done.json"))) == 0
    pairs = list(
        render_insertion(
            load_stereo_rig(CALIBRATION), SCENARIOS["clutter"], seed=7, frames=4, step=0.009
        )
    )
    insertions, truths = rows(output / "insertion.csv"), rows(output / "truth.csv")
    assert [row["name"] for row in insertions] == [f"{n:06d}.png" for n in range(4)]
    assert [float(row["insertion_m"]) for row in insertions] == [pair.insertion for pair in pairs]
    for pair, row in zip(pairs, truths, strict=True):
        for side, image in zip(("left", "right"), pair.images, strict=True):
            read = cv2.imread(str(output / side / row["name"]), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(read, image)
        if pair.truth is None:
            assert pair.number == 0
            assert all(row[key] == "" for key in COORDINATES)
            continue
        angles = [pair.truth.pitch, pair.truth.yaw, pair.truth.shaft_pitch, pair.truth.shaft_yaw]
        assert [float(row[key]) for key in COORDINATES] == [*pair.truth.tip, *angles]
        assert (float(row["left_seen"]), float(row["right_seen"])) == (1.0, 1.0)
    assert (output / "calibration.yaml").read_bytes() == CALIBRATION.read_bytes()
    done = json.loads((tmp_path / "done.json").read_text())
    assert (done["scenario"], done["frames"], done["seed"]) == ("clutter", 4, 7)


def test_without_a_needle_there_is_no_truth(tmp_path: Path) -> None:
    words = ["--scenario", "absent", "--frames", "2", "--step-mm", "40"]
    assert main(arguments(tmp_path / "a", *words)) == 0
    assert rows(tmp_path / "a" / "insertion.csv")[1]["insertion_m"] == "0.04"
    for row in rows(tmp_path / "a" / "truth.csv"):
        assert all(row[key] == "" for key in COORDINATES)
        assert (row["left_seen"], row["right_seen"]) == ("0.0", "0.0")


def test_the_stage_rests_at_its_depth() -> None:
    pairs = render_insertion(
        load_stereo_rig(CALIBRATION), SCENARIOS["clean"], seed=1, frames=5, depth=0.0105, step=0.004
    )
    seen = [(pair.insertion, pair.truth) for pair in pairs]
    assert [insertion for insertion, _ in seen] == [0.0, 0.004, 0.008, 0.0105, 0.0105]
    third, fourth = seen[3][1], seen[4][1]
    assert third is not None
    assert fourth is not None
    np.testing.assert_array_equal(third.tip, fourth.tip)


def test_the_first_frame_may_be_deep_in(tmp_path: Path) -> None:
    words = ["--start-mm", "50", "--depth-mm", "52"]
    assert main(arguments(tmp_path / "deep", *words)) == 0
    whole = list(
        render_insertion(
            load_stereo_rig(CALIBRATION),
            SCENARIOS["clean"],
            seed=0,
            frames=3,
            depth=0.052,
            step=0.026,
        )
    )
    truths = rows(tmp_path / "deep" / "truth.csv")
    assert [row["name"] for row in truths] == [f"{n:06d}.png" for n in range(3)]
    assert whole[-1].truth is not None
    assert [float(truths[-1][key]) for key in COORDINATES[:3]] == pytest.approx(
        whole[-1].truth.tip, abs=1e-12
    )


@pytest.mark.parametrize("missing", ["mitsuba", "drjit"])
def test_a_missing_extra_is_one_line_and_writes_nothing(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    missing: str,
) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    assert main(arguments(tmp_path / "out", *TRACED)) == 2
    error = capsys.readouterr().err
    assert "renderer path_traced needs Mitsuba 3, which is not installed" in error
    assert "docs/dependencies.md" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_random_paths_stay_inside_differ_and_are_smooth() -> None:
    ends = []
    for seed in range(12):
        path = random_path(seed, 0.12, (0.0175, math.inf), 1.0 / 0.122)
        plant = NeedlePlant(initial_pose(path.pitch, path.roll), curvature=1.0 / 0.122)
        tips = []
        for rotation in path.rotation:
            plant.advance(0.001, rotation)
            tips.append(plant.T_rig_tip[:3, 3])
        assert np.abs(np.array(tips)[:, 0]).max() < 0.0136
        assert np.abs(np.array(tips)[:, 1]).max() < 0.026
        assert np.abs(np.diff(path.rotation)).max() < np.deg2rad(15.0)
        ends.append(tips[-1])
    for one, other in itertools.combinations(ends, 2):
        assert np.linalg.norm(one - other) > 1e-4
    again = random_path(3, 0.12, (0.0175, math.inf), 1.0 / 0.122)
    np.testing.assert_array_equal(
        again.rotation, random_path(3, 0.12, (0.0175, math.inf), 1.0 / 0.122).rotation
    )
    with pytest.raises(UserError, match="no random path of 120 mm stays inside the phantom"):
        random_path(0, 0.12, (0.0041, math.inf), 1.0 / 0.122)


def test_truth_s_angles_give_the_directions_back() -> None:
    plant = NeedlePlant(initial_pose(0.3, 0.8), curvature=8.2)
    plant.advance(0.06, 0.5)
    pose = plant.T_rig_tip
    truth = truth_of(pose)

    def direction(pitch: float, yaw: float) -> list[float]:
        return [np.sin(pitch), -np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch)]

    np.testing.assert_allclose(direction(truth.pitch, truth.yaw), pose[:3, 2], atol=1e-12)
    line = NeedleShape().middle_line(pose, plant.centreline(0.001), 0.0003)
    # The path itself bends a little under the shaft's last 0.3 mm.
    end = (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
    np.testing.assert_allclose(direction(truth.shaft_pitch, truth.shaft_yaw), end, atol=0.006)
    np.testing.assert_array_equal(truth.tip, pose[:3, 3])


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--scenario", "fog"], "scenario 'fog' is not one of clean"),
        (["--frames", "0"], "--frames = 0 is outside [1, 999999]"),
        (["--frames", "many"], "--frames 'many' is not a whole number"),
        (["--seed", "-1"], "--seed"),
        (["--depth-mm", "nan"], "--depth-mm = nan mm is not finite"),
        (["--step-mm", "0"], "--step-mm = 0 mm is outside"),
        (["--noise", "60"], "--noise = 60 grey levels is outside [0, 50]"),
        (["--calibration", "/nowhere.yaml"], "/nowhere.yaml: cannot be read: No such file"),
        (["--start-mm", "130"], "--start-mm = 130 mm is outside [0, 120]"),
        (["--renderer", "slow"], "--renderer 'slow' is not one of quick, path_traced"),
        (["--appearance", "random"], "--appearance is for renderer path_traced"),
        ([*TRACED, "--scenario", "clean"], "--scenario is for renderer quick"),
        ([*TRACED, "--noise", "2"], "--noise is for renderer quick"),
        ([*TRACED, "--appearance", "fog"], "appearance 'fog' is not one of random"),
        (["--what"], "unrecognized arguments: --what; see --help"),
        (["--json", "/nowhere/done.json"], "--json /nowhere/done.json"),
    ],
)
def test_a_bad_argument_is_one_line_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], named: str
) -> None:
    assert main(arguments(tmp_path / "out", *words)) == 2
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


def test_help_names_every_scenario(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert all(name in text for name in SCENARIOS)
