"""calibrate_stereo and check_calibration, from drawn images to files and exit codes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from needle_tracker.calibrating.calibrate_stereo import main as calibrate_stereo
from needle_tracker.optics.calibration import load_calibration
from needle_tracker.ros.check_calibration import main as check_calibration

from .session import record
from .synthetic_rig import TrueRig, flat_pose, surface_places, under_places

Out = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def recorded(calibration_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("session")
    rig = TrueRig.read(calibration_path)
    record(folder, rig, {**surface_places(0.0175), **under_places(0.0175)}, free=7)
    return folder


@pytest.fixture
def session(recorded: Path, tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    return Path(shutil.copytree(recorded, tmp_path / "session"))


def arguments(folder: Path, *more: str) -> list[str]:
    images = ["--left", str(folder / "left"), "--right", str(folder / "right")]
    return [*images, "--session", str(folder / "session.yaml"), *more]


def one_line(out: Out) -> str:
    captured = out.readouterr()
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1
    return captured.err


def test_from_images_to_a_calibration_that_its_check_accepts(
    recorded: Path, tmp_path: Path, capsys: Out
) -> None:
    output, figures = tmp_path / "rig.yaml", tmp_path / "figures.json"
    words = arguments(recorded, "--output", str(output), "--json", str(figures))
    assert calibrate_stereo(words) == 0
    text = capsys.readouterr().out
    for line in ("left camera, under boards", "surface_height: 17.", "left.k3: NOT DETERMINED"):
        assert line in text
    calibration = load_calibration(output)
    assert calibration.left.window.inside == pytest.approx(1.3, abs=0.003)
    for picture in ("rig.rig.png", "rig.residuals.png"):
        image = cv2.imread(str(tmp_path / picture))
        assert image is not None
        assert np.ptp(image) > 200
    values = json.loads(figures.read_text())
    assert values["tip_error_p95_mm"] < 0.06
    assert values["reprojection_left_under_px"] < 0.1
    assert values["determined_refractive_index"] is True
    assert values["determined_left_k3"] is False
    assert values["problem"] is None

    words = arguments(recorded, "--calibration", str(output), "--json", str(figures))
    assert check_calibration(words) == 0
    assert capsys.readouterr().out.endswith("OK\n")
    assert json.loads(figures.read_text())["ok"] is True

    content = yaml.safe_load(output.read_text())
    content["phantom"]["refractive_index"] += 0.01
    output.write_text(yaml.safe_dump(content))
    assert check_calibration(words) == 1
    assert "refractive index is -0.0" in capsys.readouterr().out
    values = json.loads(figures.read_text())
    assert values["ok"] is False
    assert values["refractive_index_error"] == pytest.approx(-0.01, abs=0.003)
    assert values["left_camera_turned_deg"] is None


def drop(name: str, side: str) -> Callable[[Path], None]:
    return lambda folder: (folder / side / f"{name}.png").unlink()


def smaller(folder: Path) -> None:
    cv2.imwrite(str(folder / "right" / "free_3.png"), np.zeros((480, 640), np.uint8))


def broken(folder: Path) -> None:
    (folder / "right" / "free_3.png").write_bytes(b"not an image")


def empty(folder: Path) -> None:
    shutil.rmtree(folder / "left")
    (folder / "left").mkdir()


def missing(folder: Path) -> None:
    shutil.rmtree(folder / "left")


def blind(folder: Path) -> None:
    cv2.imwrite(str(folder / "right" / "free_3.png"), np.full((768, 1024), 90, np.uint8))


def another_board(folder: Path) -> None:
    path = folder / "session.yaml"
    path.write_text(path.read_text().replace("columns: 12", "columns: 11"))


def bad_session(folder: Path) -> None:
    (folder / "session.yaml").write_text("board: {}\n")


def no_image_of_a_place(folder: Path) -> None:
    for side in ("left", "right"):
        (folder / side / "under_deep.png").unlink()


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (drop("free_2", "left"), "without a partner (1): right free_2.png"),
        (smaller, "free_3.png is 640x480"),
        (broken, "cannot read"),
        (empty, "no images"),
        (missing, "does not exist"),
        (blind, "free_3: the right camera sees 0 corners"),
        (another_board, "shows the session's board (11 x 9 squares of 10 mm"),
        (bad_session, "phantom is missing"),
        (no_image_of_a_place, "places.under_deep has no image"),
    ],
)
def test_bad_input_is_one_line_and_exit_2(
    session: Path, tmp_path: Path, capsys: Out, spoil: Callable[[Path], None], says: str
) -> None:
    spoil(session)
    output = tmp_path / "rig.yaml"
    assert calibrate_stereo(arguments(session, "--output", str(output))) == 2
    assert says in one_line(capsys)
    assert not output.exists()


def test_bad_arguments_are_one_line_and_exit_2(
    recorded: Path, tmp_path: Path, calibration_path: Path, capsys: Out
) -> None:
    nowhere = str(tmp_path / "none" / "rig.yaml")
    for words in (
        [],
        ["--wrong"],
        ["--board", str(tmp_path / "board.gif")],
        arguments(recorded),
        arguments(recorded, "--output", nowhere),
        arguments(recorded, "--output", str(tmp_path / "rig.yaml"), "--goal-mm", "nan"),
    ):
        assert calibrate_stereo(words) == 2, words
        one_line(capsys)
    known = ["--calibration", str(calibration_path)]
    for words in (
        [],
        known,
        arguments(recorded, "--calibration", nowhere),
        arguments(recorded, *known, "--live", "surface_a"),
        arguments(recorded, *known, "--limit-mm", "0"),
        [*known, "--session", str(recorded / "session.yaml"), "--live", "nowhere"],
    ):
        assert check_calibration(words) == 2, words
        one_line(capsys)


def test_a_calibration_for_another_resolution(
    recorded: Path, tmp_path: Path, calibration_path: Path, capsys: Out
) -> None:
    content = yaml.safe_load(calibration_path.read_text())
    content["right"]["image_width"] = 1280
    path = tmp_path / "other.yaml"
    path.write_text(yaml.safe_dump(content))
    assert check_calibration(arguments(recorded, "--calibration", str(path))) == 2
    assert "right images are 1024x768" in one_line(capsys)


def test_a_place_given_wrong_is_pointed_at(session: Path, tmp_path: Path, capsys: Out) -> None:
    content = yaml.safe_load((session / "session.yaml").read_text())
    content["places"]["surface_b"]["origin"] = flat_pose([0.0185, -0.040, 0.0025])[:3, 3].tolist()
    (session / "session.yaml").write_text(yaml.safe_dump(content))
    figures = tmp_path / "figures.json"
    words = arguments(session, "--output", str(tmp_path / "rig.yaml"), "--json", str(figures))
    assert calibrate_stereo(words) == 1
    text = capsys.readouterr().out
    assert "NOT OK: surface_" in text
    assert "does its place hold" in json.loads(figures.read_text())["problem"]


def test_the_board_command_writes_a_board(tmp_path: Path, capsys: Out) -> None:
    assert calibrate_stereo(["--board", str(tmp_path / "board.pdf")]) == 0
    assert (tmp_path / "board.pdf").stat().st_size > 5000
    assert "100 %" in capsys.readouterr().out
