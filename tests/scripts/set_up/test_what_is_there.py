"""scripts/setup: what it says where something is missing.

The shell part runs for real, with stubs on the PATH.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

TOOLS = ("bash", "dirname", "readlink", "uname", "sed", "grep", "cat", "env")


@pytest.fixture
def stubs(tmp_path: Path) -> Path:
    """Return a folder for the PATH that holds what scripts/setup needs, but no Python."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for tool in TOOLS:
        (folder / tool).symlink_to(shutil.which(tool) or "/nonexistent")
    return folder


def add(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.unlink(missing_ok=True)
    path.write_text(f"#!{shutil.which('bash')}\n{text}\n")
    path.chmod(0o755)
    return path


def setup(root: Path, path: Path | str, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [root / "scripts" / "setup"],
        check=False,
        env={"PATH": str(path), "HOME": "/nonexistent", **variables},
        cwd="/",
        text=True,
        capture_output=True,
    )


def only_line(result: subprocess.CompletedProcess[str]) -> str:
    assert result.returncode == 2
    assert result.stdout == ""
    lines = result.stderr.splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("setup: ")
    return lines[0]


def test_another_machine(checkout: Path, stubs: Path) -> None:
    add(stubs, "uname", '[ "$1" = -s ] && echo Linux || echo aarch64')
    assert "needs Linux on x86-64" in only_line(setup(checkout, stubs))


def test_a_shim_of_an_inactive_version_is_no_python(checkout: Path, stubs: Path) -> None:
    add(stubs, "python3", 'echo "pyenv: python3: command not found" >&2; exit 127')
    add(stubs, "python3.12", "exit 10")
    assert "no Python 3.10-3.13 on the PATH" in only_line(setup(checkout, stubs))


def test_a_python_without_venv(checkout: Path, stubs: Path) -> None:
    add(stubs, "python3", "exit 11")
    assert "install python3-venv" in only_line(setup(checkout, stubs))


def test_the_first_python_that_fits_is_taken(checkout: Path, stubs: Path) -> None:
    add(stubs, "python3", "exit 11")
    add(stubs, "python3.11", '[ "$1" = -c ] || echo "$@"')
    result = setup(checkout, stubs)
    assert result.stdout == f"-I -B {checkout}/scripts/lib/setup_workspace.py --mode wheels\n"


def test_a_python_that_was_asked_for_is_not_replaced(checkout: Path, stubs: Path) -> None:
    add(stubs, "python3", "exit 0")
    line = only_line(setup(checkout, stubs, NEEDLE_PYTHON="/nonexistent/python"))
    assert "NEEDLE_PYTHON=/nonexistent/python is not a Python" in line


def test_another_ros(checkout: Path, stubs: Path) -> None:
    add(stubs, "ros2", "exit 0")
    assert "ROS 2 humble is sourced" in only_line(setup(checkout, stubs, ROS_DISTRO="humble"))


def test_ros_is_used_where_it_is_sourced_and_nothing_of_it_is_dropped(
    checkout: Path, stubs: Path
) -> None:
    add(stubs, "ros2", "exit 0")
    add(stubs, "python3", '[ "$1" = -c ] || echo "$@ $LD_LIBRARY_PATH"')
    result = setup(checkout, stubs, ROS_DISTRO="jazzy", LD_LIBRARY_PATH="/opt/ros/jazzy/lib")
    assert result.stdout.endswith("--mode ros /opt/ros/jazzy/lib\n")
