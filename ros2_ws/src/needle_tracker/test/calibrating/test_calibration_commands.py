"""calibrate_stereo and check_calibration: files, text and exit codes for given views."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from matplotlib.figure import Figure

from needle_tracker.calibrating import calibrate_stereo as calibrating
from needle_tracker.calibrating.calibrate_stereo import main as calibrate_stereo
from needle_tracker.calibrating.calibrate_stereo import rig_figure
from needle_tracker.calibrating.calibration_session import BoardView
from needle_tracker.calibrating.calibration_start import PairsApartError
from needle_tracker.calibrating.rig_calibration import RigCalibration
from needle_tracker.optics.calibration import load_calibration
from needle_tracker.ros import check_calibration as checking
from needle_tracker.ros.check_calibration import main as check_calibration
from synthetic_rig import SIZES, session_content

Out = pytest.CaptureFixture[str]
Patch = pytest.MonkeyPatch


@pytest.fixture
def arguments(tmp_path: Path) -> list[str]:
    session = tmp_path / "session.yaml"
    session.write_text(yaml.safe_dump(session_content()))
    return ["--left", "left", "--right", "right", "--session", str(session)]


@pytest.fixture
def found_views(
    views: list[BoardView], result: RigCalibration, monkeypatch: Patch
) -> dict[str, list[BoardView]]:
    """Views that both commands find in the images, and those used for the calibration."""
    nothing = dataclasses.replace(views[0].without("left").without("right"), name="blurred")
    found = {"views": [*views, nothing], "used": list[BoardView]()}

    def calibrate(used: list[BoardView], *_: object) -> RigCalibration:
        found["used"] += used
        return result

    for module in (calibrating, checking):
        monkeypatch.setattr(module, "views_in_folders", lambda *_, **__: (found["views"], SIZES))
    monkeypatch.setattr(calibrating, "calibrate", calibrate)
    monkeypatch.setattr(Figure, "savefig", lambda _, path, **__: path.write_bytes(b"png"))
    return found


def one_line(out: Out) -> str:
    captured = out.readouterr()
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1
    return captured.err


def test_a_written_calibration_passes_its_check(
    found_views: dict[str, list[BoardView]], arguments: list[str], tmp_path: Path, capsys: Out
) -> None:
    output, figures = tmp_path / "rig.yaml", tmp_path / "figures.json"
    assert calibrate_stereo([*arguments, "--output", str(output), "--json", str(figures)]) == 0
    text = capsys.readouterr().out
    for line in (
        "left camera, under boards",
        "surface_height: 17.",
        "NOT DETERMINED by these views, kept as given: 0)",
    ):
        assert line in text
    # Views in which neither camera sees the board are left out.
    assert "left out, no board found: blurred" in text
    assert [view.name for view in found_views["used"]] == [
        view.name for view in found_views["views"][:-1]
    ]
    assert load_calibration(output).left.window.inside == pytest.approx(1.3, abs=0.003)
    assert output.read_text().startswith("# views: 6 free, 2 surface, 3 under")
    assert (tmp_path / "rig.rig.png").exists()
    values = json.loads(figures.read_text())
    assert values["tip_error_p95_mm"] < 0.06
    assert values["reprojection_left_under_px"] < 0.1
    assert (values["determined_refractive_index"], values["determined_left_k3"]) == (True, False)
    assert values["surface_height_mm"] == pytest.approx(17.5, abs=0.3)
    assert values["problem"] is None

    found_views["views"] = [
        view for view in found_views["views"] if view.name in ("surface_a", "under_wedge")
    ]
    words = [*arguments, "--calibration", str(output), "--json", str(figures)]
    assert check_calibration(words) == 0
    assert capsys.readouterr().out.endswith("OK\n")
    assert json.loads(figures.read_text())["ok"] is True

    calibration = yaml.safe_load(output.read_text())
    calibration["phantom"]["refractive_index"] += 0.01
    output.write_text(yaml.safe_dump(calibration))
    assert check_calibration(words) == 1
    values = json.loads(figures.read_text())
    assert values["ok"] is False
    assert values["refractive_index_error"] == pytest.approx(-0.01, abs=0.003)
    assert values["left_camera_turned_deg"] is None


def test_contradictions_are_in_text_json_and_exit_code(
    found_views: dict[str, list[BoardView]],
    arguments: list[str],
    tmp_path: Path,
    capsys: Out,
    monkeypatch: Patch,
) -> None:
    output, figures = tmp_path / "rig.yaml", tmp_path / "figures.json"
    words = [*arguments, "--output", str(output), "--json", str(figures)]
    assert calibrate_stereo(["--board", str(tmp_path / "board.pdf")]) == 0
    assert "100 %" in capsys.readouterr().out
    assert calibrate_stereo([*words, "--goal-mm", "0.001"]) == 1
    assert "NOT within 0.001 mm" in capsys.readouterr().out
    monkeypatch.setattr(calibrating, "contradictions", lambda *_: ["does its place hold"])
    assert calibrate_stereo(words) == 1
    assert "NOT OK: does its place hold" in capsys.readouterr().out
    assert json.loads(figures.read_text())["problem"] == "does its place hold"
    output.unlink()

    def apart(*_: object) -> None:
        raise PairsApartError("free_1, not captured simultaneously")

    monkeypatch.setattr(calibrating, "calibrate", apart)
    assert calibrate_stereo(words) == 1
    assert "free_1, not captured simultaneously; nothing is written" in capsys.readouterr().out
    assert json.loads(figures.read_text())["problem"] == "free_1, not captured simultaneously"
    assert not output.exists()


def test_bad_arguments_are_reported_in_one_line_with_exit_2(
    found_views: dict[str, list[BoardView]],
    arguments: list[str],
    tmp_path: Path,
    calibration_path: Path,
    capsys: Out,
) -> None:
    nowhere, known = str(tmp_path / "none" / "rig.yaml"), ["--calibration", str(calibration_path)]
    for words in (
        [],
        ["--wrong"],
        ["--board", str(tmp_path / "board.gif")],
        arguments,
        [*arguments, "--output", nowhere],
        [*arguments, "--output", str(tmp_path / "rig.yaml"), "--goal-mm", "nan"],
    ):
        assert calibrate_stereo(words) == 2, words
        one_line(capsys)
    session = arguments[-2:]
    for words in (
        [],
        known,
        [*arguments, "--calibration", nowhere],
        [*arguments, *known, "--live", "surface_a"],
        [*known, *session, "--left", "l", "--live", "surface_a"],
        [*arguments, *known, "--limit-mm", "0"],
        [*known, *session, "--live", "nowhere"],
    ):
        assert check_calibration(words) == 2, words
        one_line(capsys)
    other = tmp_path / "other.yaml"
    text = calibration_path.read_text()
    other.write_text(text.replace("image_width: 1024", "image_width: 1280"))
    assert check_calibration([*arguments, "--calibration", str(other)]) == 2
    assert "left image is 1024x768" in one_line(capsys)


@pytest.mark.parametrize("found", ["result", "box_result"])
def test_the_picture_shows_cameras_and_boards(request: pytest.FixtureRequest, found: str) -> None:
    result: RigCalibration = request.getfixturevalue(found)
    side_view, along = rig_figure(result).axes
    for axes, axis in ((side_view, 2), (along, 1)):
        lines = [np.asarray(line.get_xydata()) for line in axes.get_lines()]
        for camera in (result.calibration.left, result.calibration.right):
            place = 1e3 * camera.centre[[axis, 0]]
            assert any(len(xy) == 1 and np.allclose(xy, place) for xy in lines)
        assert sum(len(xy) == 5 for xy in lines) == len(result.model.views)
