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


@pytest.mark.parametrize(
    ("there", "variables", "said"),
    [
        (
            {"uname": '[ "$1" = -s ] && echo Linux || echo aarch64'},
            {},
            "needs Linux on x86-64",
        ),
        # A shim of a version that is not active is no Python.
        (
            {"python3": "echo 'pyenv: command not found' >&2; exit 127", "python3.12": "exit 10"},
            {},
            "no Python 3.10-3.13 on the PATH",
        ),
        ({"python3": "exit 11"}, {}, "install python3-venv"),
        (
            {"python3": "exit 0"},
            {"NEEDLE_PYTHON": "/nonexistent/python"},
            "NEEDLE_PYTHON=/nonexistent/python is not a Python",
        ),
        ({"ros2": "exit 0"}, {"ROS_DISTRO": "humble"}, "ROS 2 humble is sourced"),
    ],
)
def test_what_is_missing_is_said_in_one_line(
    checkout: Path, stubs: Path, there: dict[str, str], variables: dict[str, str], said: str
) -> None:
    for name, text in there.items():
        add(stubs, name, text)
    result = setup(checkout, stubs, **variables)
    assert (result.returncode, result.stdout) == (2, "")
    (line,) = result.stderr.splitlines()
    assert line.startswith("setup: ")
    assert said in line


def test_the_first_python_that_fits_is_taken(checkout: Path, stubs: Path) -> None:
    add(stubs, "python3", "exit 11")
    add(stubs, "python3.11", '[ "$1" = -c ] || echo "$@"')
    result = setup(checkout, stubs)
    assert result.stdout == f"-I -B {checkout}/scripts/lib/setup_workspace.py --mode wheels\n"


def test_ros_is_used_where_it_is_sourced_and_nothing_of_it_is_dropped(
    checkout: Path, stubs: Path
) -> None:
    add(stubs, "ros2", "exit 0")
    add(stubs, "python3", '[ "$1" = -c ] || echo "$@ $LD_LIBRARY_PATH"')
    result = setup(checkout, stubs, ROS_DISTRO="jazzy", LD_LIBRARY_PATH="/opt/ros/jazzy/lib")
    assert result.stdout.endswith("--mode ros /opt/ros/jazzy/lib\n")
