"""robot_model: a written URDF agrees, and each difference of another one is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from needle_bringup.simulation.robot_model import main

CONFIG = Path(__file__).parents[3] / "needle_tracker/config"
OTHER = CONFIG / "calibration_top_and_side.yaml"


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    file = tmp_path / "rig.urdf"
    assert main([str(file)]) == 0
    return file


@pytest.fixture
def params(tmp_path: Path) -> Path:
    """Return the parameters of a driver with a shorter travel."""
    file = tmp_path / "drives.yaml"
    file.write_text("device_driver: {ros__parameters: {link: slcan, max_depth: 0.15}}")
    return file


def test_a_written_urdf_agrees_until_calibration_or_parameters_change(
    urdf: Path, params: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--check", str(urdf)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "URDF, calibration and parameters agree"
    assert main(["--check", "--params", str(params), str(urdf)]) == 1
    assert capsys.readouterr().out == "insertion_joint limit upper is 0.2, expected 0.15\n"
    assert main(["--check", "--calibration", str(OTHER), str(urdf)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(" is ")[0] for line in lines] == [
        f"{side}_camera_joint origin {what}"
        for side in ("left", "right")
        for what in ("xyz", "rpy")
    ]
    assert main(["--params", str(params), str(urdf)]) == 0
    assert main(["--check", "--params", str(params), str(urdf)]) == 0


@pytest.mark.parametrize(
    ("old", "new", "cause"),
    [
        ('"insertion_joint"', '"slide"', "insertion_joint joint type is missing"),
        ('"prismatic"', '"fixed"', "insertion_joint joint type is fixed, expected prismatic"),
        ('axis xyz="0 0 1"', 'axis xyz="0 0 -1"', "insertion_joint axis xyz is 0 0 -1"),
        ('<origin xyz="0.5174', '<origin xyz="0.5172', "left_camera_joint origin xyz is 0.5172"),
        ('rpy="0 0 0"', "", "phantom_joint origin rpy is missing, expected 0 0 0"),
    ],
)
def test_a_difference_is_named(
    urdf: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, cause: str
) -> None:
    urdf.write_text(urdf.read_text().replace(old, new))
    assert main(["--check", str(urdf)]) == 1
    assert cause in capsys.readouterr().out


def test_shapes_rounding_effort_and_further_joints_do_not_matter(urdf: Path) -> None:
    text = (
        urdf.read_text().replace("0.9 0.85 0.6 0.3", "1 0 0 1").replace("0.51749999", "0.51750001")
    )
    more = '<link name="table"/><joint name="t" type="fixed"><parent link="rig"/></joint></robot>'
    urdf.write_text(text.replace('effort="0"', 'effort="10"').replace("</robot>", more))
    assert main(["--check", str(urdf)]) == 0


def test_parameters_that_contradict_each_other_are_named(
    urdf: Path, params: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    params.write_text(params.read_text() + "\nlive_view: {ros__parameters: {max_depth: 0.2}}")
    assert main(["--check", "--params", str(params), str(urdf)]) == 1
    cause = "max_depth differs: device_driver has max_depth 0.15 m, live_view has max_depth 0.2 m"
    assert cause in capsys.readouterr().out
