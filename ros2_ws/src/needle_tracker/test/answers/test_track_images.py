"""track_images on files drawn by the tests: what comes out, and what is refused in one line."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from needle_tracker.answers.track_images import COLUMNS, main

Drawer = Callable[..., tuple[np.ndarray, np.ndarray]]
Drawn = list[tuple[np.ndarray, np.ndarray, np.ndarray]]
LENGTHS_MM = (3, 50, 51, 52, 53)


@pytest.fixture(scope="module")
def drawn(draw_pair: Drawer, make_arc: Callable[..., np.ndarray]) -> Drawn:
    """Return (tip, left, right) for each length."""
    found = []
    for mm in LENGTHS_MM:
        path = make_arc(1e-3 * mm, 5.0, 1.0)
        found.append((path[-1], *draw_pair(path, seed=mm)))
    return found


@pytest.fixture
def folder(tmp_path: Path, drawn: Drawn) -> Path:
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
    lines = ["name,insertion_m"]
    for mm, (_, left, right) in zip(LENGTHS_MM, drawn, strict=True):
        cv2.imwrite(str(tmp_path / "left" / f"image_{mm}.png"), left)
        cv2.imwrite(str(tmp_path / "right" / f"image_{mm}.png"), right)
        lines.append(f"image_{mm}.png,{1e-3 * mm}")
    (tmp_path / "insertion.csv").write_text("\n".join(lines) + "\n")
    return tmp_path


def track(folder: Path, calibration_path: Path, *more: str) -> tuple[int, list[dict[str, str]]]:
    output = folder / "tips.csv"
    output.unlink(missing_ok=True)
    arguments = ["--calibration", str(calibration_path), "--output", str(output)]
    if "--left" not in more:
        arguments += ["--left", str(folder / "left"), "--right", str(folder / "right")]
    code = main([*arguments, *more])
    if not output.exists():
        return code, []
    with output.open(newline="") as file:
        reader = csv.DictReader(file)
        rows = list(reader)
        assert reader.fieldnames == list(COLUMNS)
    return code, rows


def test_swapped_folders_are_suspected(
    tmp_path: Path,
    calibration_path: Path,
    draw_pair: Drawer,
    make_arc: Callable[..., np.ndarray],
    capsys: pytest.CaptureFixture[str],
) -> None:
    lines = ["name,insertion_m"]
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
    for mm in range(50, 65):
        for side, image in zip(
            ("right", "left"), draw_pair(make_arc(1e-3 * mm, 5.0, 1.0), seed=mm), strict=True
        ):
            cv2.imwrite(str(tmp_path / side / f"{mm}.png"), image)
        lines.append(f"{mm}.png,{1e-3 * mm}")
    (tmp_path / "insertion.csv").write_text("\n".join(lines) + "\n")
    code, rows = track(tmp_path, calibration_path, "--insertion", str(tmp_path / "insertion.csv"))
    assert code == 0
    assert {row["valid"] for row in rows} == {"0"}
    said = capsys.readouterr().err
    assert "seem to be swapped" in said
    assert "exchange --left and --right" in said


def test_every_pair_has_its_line(folder: Path, calibration_path: Path, drawn: Drawn) -> None:
    code, rows = track(folder, calibration_path, "--insertion", str(folder / "insertion.csv"))
    assert code == 0
    assert [row["name"] for row in rows] == [f"image_{mm}.png" for mm in LENGTHS_MM]
    # 3 mm: known from the stage alone, which is no measurement.
    assert [row["valid"] for row in rows] == ["0", "1", "1", "1", "1"]
    assert all(not value for key, value in rows[0].items() if key not in ("name", "valid"))
    for row, (tip, _, _) in zip(rows[1:], drawn[1:], strict=True):
        seen = np.array([float(row[f"{axis}_m"]) for axis in "xyz"])
        assert np.linalg.norm(seen - tip) < 0.25e-3
        assert all(0.0 < float(row[f"sigma_{axis}_m"]) < 0.5e-3 for axis in "xyz")
        assert abs(float(row["pitch_rad"])) < 0.3
        assert abs(float(row["yaw_rad"])) < 0.3


@pytest.mark.parametrize("agreeing", [2, 4])
def test_parameters_of_the_node_count_here_too(
    folder: Path, calibration_path: Path, agreeing: int
) -> None:
    (folder / "left" / "image_3.png").unlink()
    file = folder / "rig.yaml"
    file.write_text(f"stereo_tracker: {{ros__parameters: {{confirm_pairs: {agreeing}}}}}\n")
    code, rows = track(folder, calibration_path, "--params", str(file))
    assert code == 0
    assert [row["valid"] for row in rows] == ["0"] * (agreeing - 1) + ["1"] * (5 - agreeing)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("stereo_tracker: {ros__parameters: {needle_widht: 0.001}}", "needle_widht"),
        ("stereo_tracker: {ros__parameters: {needle_width: 1.0}}", "needle_width"),
        ("stereo_tracker: {ros__parameters: {bevel_length: 1.2}}", "bevel_length"),
        ("stereo_trakcer: {ros__parameters: {needle_width: 0.001}}", "stereo_trakcer"),
        ("/left/stereo_tracker: {ros__parameters: {}}", "this node is /stereo_tracker: write"),
        ("stereo_tracker: {ros__parameters: {seed: 1, seed: 2}}", "duplicate key 'seed' in line 1"),
    ],
)
def test_parameters_that_are_none_are_refused_in_one_line(
    folder: Path,
    calibration_path: Path,
    capsys: pytest.CaptureFixture[str],
    text: str,
    said: str,
) -> None:
    (folder / "rig.yaml").write_text(text)
    code, rows = track(folder, calibration_path, "--params", str(folder / "rig.yaml"))
    assert (code, rows) == (2, [])
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert said in lines[0]


def test_a_file_for_other_nodes_is_one_warning(
    folder: Path, calibration_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = folder / "rig.yaml"
    file.write_text("device_driver: {ros__parameters: {max_depth: 0.08}}")
    code, _ = track(folder, calibration_path, "--params", str(file))
    assert code == 0
    warning = f"warning: {file}: no section for /stereo_tracker: it has device_driver"
    assert capsys.readouterr().err.splitlines()[0] == warning


def test_an_end_without_a_long_face_is_surer(folder: Path, calibration_path: Path) -> None:
    insertion, params = str(folder / "insertion.csv"), folder / "params.yaml"
    _, unknown = track(folder, calibration_path, "--insertion", insertion)
    params.write_text("stereo_tracker: {ros__parameters: {bevel_length: 0.0001}}")
    code, known = track(folder, calibration_path, "--insertion", insertion, "--params", str(params))
    assert code == 0
    assert float(known[-1]["sigma_z_m"]) < 0.5 * float(unknown[-1]["sigma_z_m"])


def test_without_insertion_three_must_agree(folder: Path, calibration_path: Path) -> None:
    (folder / "left" / "image_3.png").unlink()
    code, rows = track(folder, calibration_path)
    assert code == 0
    assert [row["valid"] for row in rows] == ["0", "0", "1", "1"]


def test_bad_files_are_named_and_counted(
    folder: Path, calibration_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "left" / "image_51.png").write_bytes(b"no image")
    (folder / "left" / "image_52.png").write_bytes(b"")
    cv2.imwrite(str(folder / "right" / "image_53.png"), np.full((480, 640), 90, np.uint8))
    cv2.imwrite(str(folder / "right" / "image_54.png"), np.full((480, 640), 90, np.uint8))
    insertion = ("--insertion", str(folder / "insertion.csv"), "--json", str(folder / "o.json"))
    code, rows = track(folder, calibration_path, *insertion)
    assert code == 0
    assert [row["valid"] for row in rows] == ["0", "1", "0", "0", "0"]
    said = capsys.readouterr().err
    for name in ("right image_54.png", "image_51.png (left", "image_52.png (left"):
        assert name in said
    assert "image_53.png (right image is 640x480" in said
    counts = json.loads((folder / "o.json").read_text())
    assert (counts["pairs"], counts["tips"]) == (5, 1)
    assert (counts["unpaired"], counts["unreadable"]) == (1, 3)


def test_videos_serve_too(folder: Path, calibration_path: Path, drawn: Drawn) -> None:
    for side in (1, 2):
        # Without loss; a codec that every OpenCV has.
        code = cv2.VideoWriter.fourcc(*"FFV1")
        video = cv2.VideoWriter(str(folder / f"{side}.avi"), code, 10.0, (1024, 768), False)
        for images in drawn[side:]:
            video.write(images[side])
        video.release()
    (folder / "by_number.csv").write_text("name,insertion_m\n000000,0.051\n")
    code, rows = track(
        folder,
        calibration_path,
        *("--left", str(folder / "1.avi"), "--right", str(folder / "1.avi")),
    )
    assert code == 0
    assert [row["name"] for row in rows] == [f"{number:06d}" for number in range(4)]
    assert {row["valid"] for row in rows} == {"0"}  # one camera twice: no depth


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--calibration", "nothing.yaml"], "nothing.yaml"),
        (["--insertion", "nothing.csv"], "nothing.csv"),
        (["--left", "nowhere", "--right", "nowhere"], "nowhere"),
        (["--needle-width-mm", "seven"], "seven"),
        (["--unknown"], "--unknown"),
    ],
)
def test_what_is_missing_is_one_line(
    folder: Path,
    calibration_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    named: str,
) -> None:
    code, rows = track(folder, calibration_path, *arguments)
    said = capsys.readouterr().err
    assert code == 2
    assert not rows
    assert said.count("\n") == 1
    assert named in said


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("name,insertion\na,1\n", "insertion_m"),
        ("name,insertion_m\na,far\n", "line 2"),
        ("name,insertion_m\na,nan\n", "line 2"),
        ("name,insertion_m\na,0.1\na,0.2\n", "line 3"),
        ("", "name"),
    ],
)
def test_a_bad_insertion_file_is_refused(
    folder: Path,
    calibration_path: Path,
    capsys: pytest.CaptureFixture[str],
    text: str,
    named: str,
) -> None:
    (folder / "bad.csv").write_text(text)
    code, _ = track(folder, calibration_path, "--insertion", str(folder / "bad.csv"))
    assert code == 2
    assert named in capsys.readouterr().err


def test_a_calibration_for_another_resolution_is_refused(
    folder: Path, calibration_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = calibration_path.read_text().replace("image_width: 1024", "image_width: 1280")
    other = folder / "other.yaml"
    other.write_text(text)
    code, _ = track(folder, other)
    assert code == 2
    assert "1280x768" in capsys.readouterr().err


def test_images_of_the_empty_phantom_are_read_and_refused_by_name(
    folder: Path, calibration_path: Path, drawn: Drawn, capsys: pytest.CaptureFixture[str]
) -> None:
    params, empty = folder / "params.yaml", folder / "empty"
    params.write_text(
        f"stereo_tracker: {{ros__parameters: {{reference_folder: {empty.as_posix()}}}}}\n"
    )
    for side in ("left", "right"):
        (empty / side).mkdir(parents=True)
        cv2.imwrite(str(empty / side / "0.png"), np.full_like(drawn[0][1], 200))
    code, rows = track(folder, calibration_path, "--params", str(params))
    assert code == 0
    assert [row["valid"] for row in rows][-1] == "1"
    cv2.imwrite(str(empty / "right" / "0.png"), np.zeros((480, 640), np.uint8))
    code, _ = track(folder, calibration_path, "--params", str(params))
    assert code == 2
    assert "right/0.png: not an image of 1024x768" in capsys.readouterr().err


def write_truth(folder: Path, drawn: Drawn, off: tuple[float, float, float] = (0, 0, 0)) -> Path:
    lines = ["name,x_m,y_m,z_m,more"]
    for mm, (tip, _, _) in zip(LENGTHS_MM, drawn, strict=True):
        x, y, z = np.asarray(tip) + np.array(off)
        lines.append(f"image_{mm}.png,{x},{y},{z},")
    (folder / "truth.csv").write_text("\n".join(lines) + "\n")
    return folder / "truth.csv"


def test_tips_are_held_against_the_truth(
    folder: Path, calibration_path: Path, drawn: Drawn, capsys: pytest.CaptureFixture[str]
) -> None:
    insertion = ("--insertion", str(folder / "insertion.csv"))
    seen = []
    for off in ((0.0, 0.0, 0.0), (0.0, 0.0, 0.001)):
        truth = ("--truth", str(write_truth(folder, drawn, off)), "--json", str(folder / "o.json"))
        code, rows = track(folder, calibration_path, *insertion, *truth)
        assert code == 0
        seen.append(json.loads((folder / "o.json").read_text()))
        assert (seen[-1]["compared"], seen[-1]["missed"]) == (4, 1)
        found = np.array([[float(row[f"{a}_m"]) for a in "xyz"] for row in rows[1:]])
        true = np.array([np.asarray(tip) + np.array(off) for tip, _, _ in drawn[1:]])
        size = np.linalg.norm(found - true, axis=1) * 1e3
        assert seen[-1]["error_max_mm"] == pytest.approx(np.max(size), abs=1e-5)
        assert seen[-1]["error_rms_mm"] == pytest.approx(np.sqrt(np.mean(size**2)), abs=1e-5)
        assert f"error  {seen[-1]['error_rms_mm']:.3f} mm rms" in capsys.readouterr().out
    right, wrong = seen
    assert right["error_sigmas"] < 1.5
    assert right["inside_95"] == 1.0
    # A millimetre along the needle is many of its standard deviations.
    assert wrong["error_z_rms_mm"] == pytest.approx(1.0, abs=0.1)
    assert wrong["error_sigmas"] > 5.0
    assert wrong["inside_95"] == 0.0
    assert wrong["error_y_rms_mm"] < 0.1


def test_a_tip_where_there_is_no_needle_is_counted(
    folder: Path, calibration_path: Path, drawn: Drawn
) -> None:
    lines = write_truth(folder, drawn).read_text().splitlines()
    lines[3] = "image_51.png,,,,"
    (folder / "truth.csv").write_text("\n".join(lines[:-1]) + "\n")
    words = ("--insertion", "insertion.csv", "--truth", "truth.csv", "--json", "o.json")
    paths = (str(folder / w) if "." in w else w for w in words)
    assert track(folder, calibration_path, *paths)[0] == 0
    told = json.loads((folder / "o.json").read_text())
    keys = ("compared", "missed", "tips_without_needle", "without_truth")
    assert [told[key] for key in keys] == [2, 1, 1, 1]
    assert track(folder, calibration_path, "--json", str(folder / "o.json"))[0] == 0
    assert json.loads((folder / "o.json").read_text())["compared"] is None


def test_what_was_found_is_drawn(folder: Path, calibration_path: Path) -> None:
    (folder / "left" / "image_52.png").write_bytes(b"no image")
    words = ("--insertion", str(folder / "insertion.csv"), "--overlay", str(folder / "seen"))
    assert track(folder, calibration_path, *words)[0] == 0
    names = sorted(path.name for path in (folder / "seen").iterdir())
    assert names == [f"image_{mm}.jpg" for mm in (3, 50, 51, 53)]
    drawn = cv2.imread(str(folder / "seen" / "image_53.jpg"))
    assert drawn is not None
    picture = drawn.astype(int)
    # Green, as BGR.
    is_green = (picture[..., 1] - picture[..., 2] > 60) & (picture[..., 1] - picture[..., 0] > 60)
    assert np.count_nonzero(is_green) > 20


@pytest.mark.parametrize(
    ("truth", "said"),
    [
        ("name,x_m,y_m\n", "no column 'z_m'"),
        ("name,x_m,y_m,z_m\na,1,2,\n", "line 2: z_m = '' is not a finite number"),
        ("name,x_m,y_m,z_m\na,1,2,3\na,1,2,3\n", "line 3: 'a' is there already"),
    ],
)
def test_a_truth_that_is_none_is_refused_in_one_line(
    folder: Path,
    calibration_path: Path,
    capsys: pytest.CaptureFixture[str],
    truth: str,
    said: str,
) -> None:
    (folder / "t.csv").write_text(truth)
    assert track(folder, calibration_path, "--truth", str(folder / "t.csv"))[0] == 2
    assert said in capsys.readouterr().err
    assert track(folder, calibration_path, "--overlay", str(folder / "left"))[0] == 2
    assert "has something in it" in capsys.readouterr().err
