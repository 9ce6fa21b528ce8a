"""track_images: results of folders and videos, and one-line errors."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from needle_tracker.answers import track_images
from needle_tracker.answers.track_images import COLUMNS, main
from needle_tracker.filter.measurement import Measurement, TrackState
from needle_tracker.stereo.triangulation import SpatialTip
from needle_tracker.tracker_parameters import StereoTrackerParameters

Out = pytest.CaptureFixture[str]
LENGTHS_MM = (3, 50, 51, 52)
SIGMA = 1e-4


class Scripted:
    """Stand-in for the tracker: an image's brightness is the tip's depth [mm]; entry at 3 mm."""

    made: list[StereoTrackerParameters]
    references: list[Any]
    resets: list[float | None]

    def __init__(self, _: object, settings: StereoTrackerParameters, reference: Any) -> None:
        self.made.append(settings)
        self.references.append(reference)

    def warm_up(self) -> None:
        pass

    def reset(self) -> None:
        self.resets.append(None)

    def skip(self, reason: str) -> Measurement:
        return Measurement(None, TrackState.SEARCHING, reason)

    def process(self, left: np.ndarray, right: np.ndarray, insertion: float | None) -> Measurement:
        mm = int(left[0, 0])
        if mm == 0:
            return Measurement(None, TrackState.SEARCHING, "left image is black")
        tip = SpatialTip(
            np.array([0.0, 0.0, 1e-3 * mm]),
            SIGMA**2 * np.eye(3),
            np.array([math.sin(0.1), -0.2, 0.8]),
            np.eye(3),
        )
        return Measurement(tip, TrackState.ENTRY if mm == 3 else TrackState.TRACKING, "")


@pytest.fixture(autouse=True)
def scripted(monkeypatch: pytest.MonkeyPatch) -> type[Scripted]:
    Scripted.made, Scripted.references, Scripted.resets = [], [], []
    monkeypatch.setattr(track_images, "NeedleTracker", Scripted)
    return Scripted


def save(path: Path, mm: int, size: tuple[int, int] = (768, 1024)) -> None:
    cv2.imwrite(str(path), np.full(size, mm, np.uint8))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        for mm in LENGTHS_MM:
            save(tmp_path / side / f"image_{mm}.png", mm)
    lines = [f"image_{mm}.png,{1e-3 * mm}" for mm in LENGTHS_MM]
    (tmp_path / "insertion.csv").write_text("\n".join(["name,insertion_m", *lines]) + "\n")
    return tmp_path


@pytest.fixture
def track(folder: Path, calibration_path: Path) -> Callable[..., tuple[int, list[dict[str, str]]]]:
    """Run the command in the folder; bare file names are in it."""

    def run(*more: str) -> tuple[int, list[dict[str, str]]]:
        output = folder / "tips.csv"
        output.unlink(missing_ok=True)
        given = {"--calibration": str(calibration_path), "--output": str(output)}
        given |= {f"--{side}": str(folder / side) for side in ("left", "right")}
        words = [
            str(folder / w) if w.endswith((".csv", ".txt", ".avi", ".json")) and "/" not in w else w
            for w in more
        ]
        code = main([*(word for pair in given.items() for word in pair), *words])
        if not output.exists():
            return code, []
        with output.open(newline="") as file:
            reader = csv.DictReader(file)
            rows = list(reader)
            assert reader.fieldnames == list(COLUMNS)
        return code, rows

    return run


Track = Callable[..., tuple[int, list[dict[str, str]]]]


def test_every_pair_has_a_line_and_unusable_images_are_named(
    track: Track, folder: Path, capsys: Out
) -> None:
    (folder / "left" / "image_51.png").write_bytes(b"no image")
    save(folder / "right" / "image_52.png", 52, (480, 640))
    save(folder / "left" / "image_53.png", 53)
    save(folder / "left" / "image_60.png", 0)
    save(folder / "right" / "image_60.png", 0)
    code, rows = track("--insertion", "insertion.csv", "--json", "o.json")
    assert code == 0
    assert [row["name"] for row in rows] == [f"image_{mm}.png" for mm in (3, 50, 51, 52, 60)]
    # 3 mm follows from the stage alone, which is not a measurement.
    assert [row["valid"] for row in rows] == ["0", "1", "0", "0", "0"]
    missing = [row["missing"] for row in rows]
    unusable = ["left image is unreadable or not of 8 bit"]
    unusable.append("right image is 640x480, the calibration is for 1024x768")
    assert missing == ["in the entry zone", "", *unusable, "left image is black"]
    assert not any(rows[0][column] for column in COLUMNS[2:-1])
    found = {column: float(rows[1][column]) for column in COLUMNS[2:10]}
    sigmas = {f"sigma_{axis}_m": SIGMA for axis in "xyz"}
    place = {"x_m": 0.0, "y_m": 0.0, "z_m": 0.05, "pitch_rad": 0.1, "yaw_rad": math.atan(0.25)}
    assert found == pytest.approx(place | sigmas)
    captured = capsys.readouterr()
    for name in ("left image_53.png", "image_51.png (left", "image_52.png (right image is 640x480"):
        assert name in captured.err
    assert "1 x  left image is black" in captured.out
    summary = json.loads((folder / "o.json").read_text())
    assert (summary["pairs"], summary["tips"], summary["without_insertion"]) == (5, 1, 1)
    assert (summary["unpaired"], summary["unreadable"], summary["compared"]) == (1, 2, None)
    # Images at 3 and 50 mm are not one sequence of a needle.
    assert len(Scripted.resets) == 1


def test_parameters_of_the_node_apply(track: Track, folder: Path, capsys: Out) -> None:
    params = folder / "rig.yaml"
    params.write_text(
        "stereo_tracker: {ros__parameters: {stage_zero_sigma: 0.002, needle_width: 0.001}}"
    )
    assert track("--params", str(params))[0] == 0
    (first,) = Scripted.made
    assert (first.stage_zero_sigma, first.needle_width) == (0.002, 0.001)
    for side, mm in (("left", 7), ("right", 9)):
        (folder / "empty" / side).mkdir(parents=True)
        save(folder / "empty" / side / "0.png", mm)
        save(folder / "empty" / side / "1.png", mm + 4)
    params.write_text(NODE % f"reference_folder: {folder / 'empty'}")
    assert track("--params", str(params))[0] == 0
    reference = Scripted.references[-1]
    assert [np.unique(image).tolist() for image in reference] == [[9], [11]]
    save(folder / "empty" / "right" / "0.png", 9, (480, 640))
    assert track("--params", str(params))[0] == 2
    assert "empty, 0.png: right image is 640x480" in capsys.readouterr().err
    params.write_text("device_driver: {ros__parameters: {max_depth: 0.08}}")
    assert track("--params", str(params))[0] == 0
    warning = f"warning: {params}: no section for /stereo_tracker: it has device_driver"
    assert capsys.readouterr().err.splitlines()[0] == warning


CSV = "name,insertion_m\n"
TRUTH = "name,x_m,y_m,z_m\n"
NODE = "stereo_tracker: {ros__parameters: {%s}}"


def test_unusable_input_is_reported_in_one_line(track: Track, folder: Path, capsys: Out) -> None:
    given = folder / "given.txt"
    for option, text, cause in (
        ("--params", NODE % "needle_widht: 0.001", "needle_widht"),
        ("--params", NODE % "reference_folder: /nowhere", "/nowhere"),
        ("--insertion", "name,insertion\na,1\n", "insertion_m"),
        ("--insertion", CSV + "a,far\n", "line 2"),
        ("--insertion", CSV + "a,0.1\na,0.2\n", "line 3"),
        ("--insertion", "", "name"),
        ("--truth", TRUTH + "a,1,2,\n", "line 2: z_m '' is not a number"),
        ("--insertion", None, "No such file"),
        ("--overlay", "", "File exists|is not empty|Not a directory"),
    ):
        given.unlink(missing_ok=True)
        if text is not None:
            given.write_text(text)
        code, rows = track(option, "given.txt")
        error = capsys.readouterr().err
        assert (code, rows, error.count("\n")) == (2, [], 1)
        assert any(one in error for one in cause.split("|")), error


def test_wrong_options_are_reported_in_one_line(track: Track, folder: Path, capsys: Out) -> None:
    for words in (["--unknown"], ["--overlay", str(folder)]):
        code, rows = track(*words)
        assert (code, rows, capsys.readouterr().err.count("\n")) == (2, [], 1)
    for side in ("left", "right"):
        for mm in LENGTHS_MM:
            save(folder / side / f"image_{mm}.png", mm, (480, 640))
    assert track()[0] == 2
    assert "image is 640x480, the calibration is for 1024x768" in capsys.readouterr().err


def test_videos_are_read(track: Track, folder: Path) -> None:
    # A lossless codec that every OpenCV has.
    path, codec = folder / "both.avi", cv2.VideoWriter.fourcc(*"FFV1")
    video = cv2.VideoWriter(str(path), codec, 10.0, (1024, 768), False)
    for mm in (50, 51):
        video.write(np.full((768, 1024), mm, np.uint8))
    video.release()
    code, rows = track("--left", "both.avi", "--right", "both.avi")
    assert code == 0
    assert [row["name"] for row in rows] == ["000000", "000001"]
    assert [float(row["z_m"]) for row in rows] == pytest.approx([0.050, 0.051], abs=2e-3)


def test_tips_are_compared_with_the_truth(track: Track, folder: Path, capsys: Out) -> None:
    # 50 is right, 51 is wrong by 1 mm, 3 and 52 have no needle, and 60 has no truth.
    lines = ["image_50.png,0,0,0.05", "image_51.png,0,0,0.052", "image_52.png,,,", "image_3.png,,,"]
    for side in ("left", "right"):
        save(folder / side / "image_60.png", 60)
    (folder / "truth.csv").write_text(TRUTH + "\n".join(lines) + "\n")
    words = ("--truth", "truth.csv", "--json", "o.json")
    assert track(*words)[0] == 0
    summary = json.loads((folder / "o.json").read_text())
    keys = ("compared", "missed", "tips_without_needle", "without_truth")
    assert [summary[key] for key in keys] == [2, 0, 1, 1]
    assert summary["error_rms_mm"] == summary["error_z_rms_mm"] == pytest.approx(math.sqrt(0.5))
    assert (summary["error_max_mm"], summary["error_x_rms_mm"]) == pytest.approx((1.0, 0.0))
    # A millimetre is ten standard deviations.
    assert summary["error_sigmas"] == pytest.approx(math.sqrt(100.0 / 2.0 / 3.0))
    assert summary["inside_95"] == 0.5
    assert "error  0.707 mm rms" in capsys.readouterr().out
    save(folder / "left" / "image_50.png", 0)
    assert track(*words)[0] == 0
    assert json.loads((folder / "o.json").read_text())["missed"] == 1


def test_overlays_are_drawn(track: Track, folder: Path) -> None:
    (folder / "left" / "image_51.png").write_bytes(b"no image")
    assert track("--overlay", str(folder / "seen"))[0] == 0
    assert sorted(path.stem for path in (folder / "seen").iterdir()) == [
        f"image_{mm}" for mm in (3, 50, 52)
    ]
    assert cv2.imread(str(folder / "seen" / "image_50.jpg")) is not None


def test_swapped_folders_are_suspected(
    track: Track, monkeypatch: pytest.MonkeyPatch, capsys: Out
) -> None:
    class Suspects:
        suspected = True

        def __init__(self, *_: Any) -> None:
            pass

        def update(self, *_: Any) -> None:
            pass

    monkeypatch.setattr(track_images, "SwapWatch", Suspects)
    assert track()[0] == 0
    assert "exchange --left and --right" in capsys.readouterr().err
