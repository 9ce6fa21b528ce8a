"""The command `identify_curvature`: files, bags and messages."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.random import default_rng

from made_up_run import SyntheticBag, header, message, vector
from needle_controller.curvature.curvature_data import read_record
from needle_controller.curvature.identify_curvature import main
from needle_controller.model.arrays import Array
from needle_core.errors import UserError

from .insertions import STEP, insertion_tips, uniform

COLUMNS = ["name", "valid", "x_m", "y_m", "z_m", "insertion_m", "rotation_rad"]


def command(*arguments: str | Path) -> int:
    return main([str(argument) for argument in arguments])


def write_csv(
    path: Path, tips: Array, insertion: Array | None = None, rotation: Array | None = None
) -> Path:
    numbers = [column for column in (*tips.T, insertion, rotation) if column is not None]
    names = COLUMNS[: 2 + len(numbers)]
    rows = [",".join(map(str, row)) for row in zip(*numbers, strict=True)]
    lines = [f"image_{number:03d}.png,1,{row}" for number, row in enumerate(rows)]
    lines.insert(5, "lost.png,0" + "," * len(numbers))
    path.write_text("\n".join([",".join(names), *lines]), encoding="utf-8")
    return path


@pytest.fixture
def needle() -> tuple[Array, Array]:
    rng = default_rng(8)
    tips, insertion = insertion_tips(1, 0.12, rng, heading_std=0.02)
    return uniform(tips[0], rng), insertion


def test_a_steered_insertion_without_rotation_is_rejected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = default_rng(3)
    tips, insertion = insertion_tips(1, 0.06, rng, turn=math.radians(90.0))
    noisy = tips[0] + rng.normal(0.0, 3e-5, tips[0].shape)
    path = write_csv(tmp_path / "tips.csv", noisy, insertion)
    assert command(path) == 2
    error = capsys.readouterr().err
    assert "the tips do not follow a single arc" in error
    assert "--until-mm" in error
    assert error.count("\n") == 1
    assert command(path, "--until-mm", "30") == 0
    # A recorded rotation of 0 is accepted.
    assert command(write_csv(path, noisy, insertion, 0.0 * insertion)) == 0


@pytest.mark.parametrize("known", [True, False])
def test_command_reads_a_csv(
    tmp_path: Path, needle: tuple[Array, Array], known: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    tips, insertion = needle
    path = write_csv(tmp_path / "tips.csv", tips, insertion if known else None)
    assert command(path, "--json", tmp_path / "out.json") == 0
    out, err = capsys.readouterr()
    values = json.loads((tmp_path / "out.json").read_text())
    assert out.startswith(f"1/kappa = {values['radius_mm']:.1f} mm (95 %: ")
    assert values["radius_low_mm"] < 122.0 < values["radius_high_mm"]
    assert values["tips"] == 121
    assert values["insertion_known"] is known
    assert (values["slip"] is not None) is known
    assert "rotation" not in out
    assert "not recorded" in err


def test_command_reads_insertions_by_name(tmp_path: Path, needle: tuple[Array, Array]) -> None:
    tips, insertion = needle
    path, by_name = write_csv(tmp_path / "tips.csv", tips), tmp_path / "insertion.csv"
    text = "\n".join(f"image_{i:03d}.png,{v}" for i, v in enumerate(insertion))
    for written in (text, text.replace(".png", "")):
        by_name.write_text(f"name,insertion_m\n{written}")
        found = read_record(path, by_name).insertion
        np.testing.assert_allclose(np.array(found, dtype=float), insertion)
    by_name.write_text(f"name,insertion_m\n{text.rpartition(',')[0]},")
    with pytest.raises(UserError, match=r"no insertion for image_120\.png"):
        read_record(path, by_name)


def test_a_turned_base_is_rejected_except_for_the_part_before(
    tmp_path: Path, needle: tuple[Array, Array], capsys: pytest.CaptureFixture[str]
) -> None:
    tips, insertion = needle
    rotation = np.where(insertion > 0.0805, 0.3, 0.0)
    path = write_csv(tmp_path / "tips.csv", tips, insertion, rotation)
    assert command(path) == 2
    error = capsys.readouterr().err
    assert "the base turned by 17.19 deg" in error
    assert "from 81.0 mm of insertion on" in error
    assert error.count("\n") == 1
    assert command(path, "--until-mm", "80.5") == 0
    assert "81 tips over 80.0 mm" in capsys.readouterr().out


def test_bad_files_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "tips.csv"
    for text, cause in (
        ("x_m,y_m,z_m\n", "the file has no rows"),
        ("a,b\n1,2\n", "x_m is missing"),
        ("x_m,y_m,z_m\n0,0,0.01\n", "1 tips are too few"),
        ("x_m,y_m,z_m\n0,0,nan\n", "z_m = nan m is not finite"),
        ("x_m,y_m,z_m\n0,0,left\n", "z_m 'left' is not a number"),
        ("x_m,y_m,z_m\n0,0,12.5\n", r"z_m = 12.5 m is outside"),
        ("x_m,y_m,z_m\n0,0,1,2\n", "more fields than columns"),
    ):
        path.write_text(text)
        assert command(path) == 2
        error = capsys.readouterr().err
        assert cause in error
        assert error.count("\n") == 1


def test_a_straight_path_exits_with_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    insertion = np.arange(0.0, 0.02, STEP)
    tips = uniform(insertion[:, None] * np.array([0.0, 0.0, 1.0]), default_rng(9))
    path = write_csv(tmp_path / "tips.csv", tips, insertion, 0.0 * insertion)
    assert command(path, "--json", tmp_path / "out.json") == 1
    assert "more than" in capsys.readouterr().out
    assert json.loads((tmp_path / "out.json").read_text())["radius_high_mm"] is None


def write_bag(path: Path, tips: Array, insertion: Array, rotation: Array) -> Path:
    written, none = SyntheticBag(path, "/a/"), np.empty(0)
    joints = {"name": ["insertion_joint", "rotation_joint"], "velocity": none, "effort": none}
    for tip, *position in zip(tips, insertion, rotation, strict=True):
        written.now += 10**9
        joints |= {"header": header(written.now), "position": np.array(position)}
        written.put("joint_states", message("sensor_msgs/msg/JointState", **joints))
        measured = {"header": header(written.now + 500), "point": vector(tip, "Point")}
        written.put("needle/tip", message("geometry_msgs/msg/PointStamped", **measured))
    written.bag.close()
    return path


def test_command_reads_a_bag(
    tmp_path: Path, needle: tuple[Array, Array], capsys: pytest.CaptureFixture[str]
) -> None:
    tips, insertion = needle
    # The retraction at the end is omitted.
    back = slice(-2, -32, -1)
    path = write_bag(
        tmp_path / "bag",
        np.concatenate([tips, tips[back]]),
        1.05 * np.concatenate([insertion, insertion[back]]),
        np.concatenate([0.0 * insertion, 0.5 + 0.0 * insertion[back]]),
    )
    assert command(path, "--json", tmp_path / "out.json") == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "121 tips over 126.0 mm" in out
    values = json.loads((tmp_path / "out.json").read_text())
    assert values["radius_low_mm"] < 122.0 < values["radius_high_mm"]
    assert values["slip"] == pytest.approx(0.05, abs=3.0 * values["slip_std"])
    assert values["slip_std"] < 0.003
    assert f"the stage moved {100.0 * values['slip']:.1f} % farther" in out


def test_a_bag_without_a_needle_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_bag(tmp_path / "bag", np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    assert command(path) == 2
    assert "no messages on needle/tip" in capsys.readouterr().err
