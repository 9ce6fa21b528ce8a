"""The small `ros2` of environments without ROS 2's command line."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

STAND_IN = Path(__file__).parents[2] / "scripts" / "lib" / "ros2_standin.py"


@pytest.fixture
def prefix(tmp_path: Path) -> Path:
    """Return an install prefix, with a space in its path, that holds one package."""
    prefix = tmp_path / "with a space"
    index = prefix / "share/ament_index/resource_index/packages"
    index.mkdir(parents=True)
    (index / "needle_sim").touch()
    (prefix / "lib" / "needle_sim").mkdir(parents=True)
    return prefix


def add(prefix: Path, name: str, text: str) -> None:
    path = prefix / "lib" / "needle_sim" / name
    path.write_text(text)
    path.chmod(0o755)


def ros2(prefix: Path | None, *arguments: str) -> subprocess.CompletedProcess[str]:
    env = dict(os.environ, AMENT_PREFIX_PATH="" if prefix is None else f"/nonexistent:{prefix}")
    return subprocess.run(
        [sys.executable, "-I", "-S", str(STAND_IN), *arguments],
        check=False,
        env=env,
        text=True,
        capture_output=True,
    )


def test_run_passes_arguments_output_and_exit_code(prefix: Path) -> None:
    # An interpreter path with a space cannot be run by the kernel; the stand-in uses its own.
    add(
        prefix,
        "sim_rig",
        '#!"/a folder/bin/python3"\nimport sys\nprint(sys.argv[1:])\nsys.exit(7)\n',
    )
    result = ros2(prefix, "run", "needle_sim", "sim_rig", "--ros-args", "-p", "a:=b c", "--help")
    assert result.stdout == "['--ros-args', '-p', 'a:=b c', '--help']\n"
    assert result.returncode == 7


def test_run_becomes_the_executable_so_that_signals_reach_it(prefix: Path) -> None:
    add(prefix, "pause", "#!/usr/bin/python3\nprint('up', flush=True)\ninput()\n")
    with subprocess.Popen(
        [sys.executable, "-I", "-S", str(STAND_IN), "run", "needle_sim", "pause"],
        env=dict(os.environ, AMENT_PREFIX_PATH=str(prefix)),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        process.send_signal(signal.SIGTERM)
        assert process.wait() == -signal.SIGTERM


def test_lists_executables(prefix: Path) -> None:
    add(prefix, "sim_rig", "")
    add(prefix, "monte_carlo", "")
    expected = "needle_sim monte_carlo\nneedle_sim sim_rig\n"
    assert ros2(prefix, "pkg", "executables").stdout == expected
    assert ros2(prefix, "pkg", "executables", "needle_sim").stdout == expected


@pytest.mark.parametrize(
    ("arguments", "code", "hint"),
    [
        (["run", "needle_sin", "sim_rig"], 1, "did you mean needle_sim?"),
        (["run", "needle_sim", "simrig"], 1, "did you mean sim_rig?"),
        (["run", "needle_sim", "zzz"], 1, "there is sim_rig"),
        (["pkg", "executables", "zzz"], 1, "there is needle_sim"),
        (["run", "needle_sim"], 2, "usage: ros2 run PACKAGE EXECUTABLE"),
        (["bag", "info"], 2, "`ros2 bag` needs an installed ROS 2 Jazzy"),
        (["pkg", "create"], 2, "stand-in knows only"),
    ],
)
def test_says_in_one_line_what_is_wrong(
    prefix: Path, arguments: list[str], code: int, hint: str
) -> None:
    add(prefix, "sim_rig", "")
    result = ros2(prefix, *arguments)
    assert result.returncode == code
    assert hint in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_says_that_the_environment_is_missing() -> None:
    result = ros2(None, "run", "needle_sim", "sim_rig")
    assert result.returncode == 1
    assert "source scripts/env.sh first" in result.stderr
