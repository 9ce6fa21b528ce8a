"""The small `ros2` command for environments without the ROS 2 command line."""

from __future__ import annotations

import runpy
import sys
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

import pytest

from needle_core.commands import small_ros2

FOLDERS = sorted(path.parent for path in Path(__file__).parents[2].glob("ros2_ws/src/*/setup.py"))


def ros2(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["ros2", *arguments])
    return small_ros2.main()


def test_pip_installs_the_executables_that_colcon_installs() -> None:
    (core,) = (folder for folder in FOLDERS if folder.name == "needle_core")
    executables = runpy.run_path(str(core / "package_setup.py"))["executables"]
    of_pip = entry_points(group="console_scripts")
    found = {f"{one.name} = {one.value}" for one in of_pip if ".executables:" in one.value}
    assert found == {line for folder in FOLDERS for line in executables(folder)}
    assert len(found) == 28


def test_run_passes_arguments_and_exit_code(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    points = (EntryPoint("show", f"{__name__}.executables:show", "console_scripts"),)
    monkeypatch.setattr(small_ros2, "entry_points", lambda group: points)
    monkeypatch.setattr(EntryPoint, "load", lambda _: lambda: print(sys.argv) or 7)
    with pytest.raises(SystemExit) as end:
        ros2(monkeypatch, "run", __name__, "show", "-p", "a:=b c", "--help")
    assert end.value.code == 7
    assert capsys.readouterr().out == "['show', '-p', 'a:=b c', '--help']\n"


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["run", "needle_sin", "sim_rig"], "did you mean 'needle_sim'?"),
        (["run", "needle_sim", "simrig"], "did you mean 'sim_rig'?"),
        (["pkg", "executables", "zzz"], "known: needle_"),
    ],
)
def test_errors_are_one_line(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    hint: str,
) -> None:
    assert ros2(monkeypatch, *arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert hint in line


@pytest.mark.parametrize(("arguments", "code"), [(["--help"], 0), (["bag"], 2)])
def test_help_refers_to_ros_2_for_everything_else(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    code: int,
) -> None:
    assert ros2(monkeypatch, *arguments) == code
    assert "For everything else (bag, launch, ...) install ROS 2 Jazzy" in capsys.readouterr().out
