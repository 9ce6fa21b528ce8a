"""scripts/setup: its actions, the steps that it skips, and its messages.

It runs for real, with stubs for Python and uv on the PATH: no test downloads anything.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TOOLS = (
    *("bash", "basename", "cat", "chmod", "cut", "dirname", "env", "flock", "grep", "ls", "mkdir"),
    *("readlink", "rm", "sha256sum", "sort", "touch", "uname", "xargs"),
)
# Records its arguments; its virtual environments contain it again, as Python and as uv.
STUB = """\
case "$*" in
*ensurepip*) echo "${PREFIX-/usr}" ;;
*"-m venv"*)
    echo venv >>"$NOTES"
    mkdir -p .venv/bin
    echo 'exec python3 "$@"' >.venv/bin/python
    printf '#!/bin/bash\\necho "uv $*" >>"$NOTES"; exit ${UV_CODE:-0}\\n' >.venv/bin/uv
    chmod +x .venv/bin/*
    ;;
esac
"""
FIRST = ["venv", "uv -e .[ros] --group test"]


class Checkout:
    """A checkout in a path with a space, and the tools that its scripts find."""

    def __init__(self, folder: Path) -> None:
        self.root, self.tools, self.notes = folder / "a space", folder / "bin", folder / "notes"
        shutil.copytree(ROOT / "scripts", self.root / "scripts")
        package = self.root / "ros2_ws" / "src" / "needle_one"
        for name in ("config/a.yaml", "launch/a.py", "needle_one/executables.py", "setup.cfg"):
            (package / name).parent.mkdir(parents=True, exist_ok=True)
            (package / name).touch()
        (package / "needle_one" / "fast.py").write_text("@compiled\n")
        for path in (package / "package.xml", package / "setup.py"):
            path.touch()
        for name in ("pyproject.toml", "setup.py", "requirements.lock"):
            (self.root / name).touch()
        self.tools.mkdir()
        for tool in TOOLS:
            (self.tools / tool).symlink_to(shutil.which(tool) or "/nonexistent")
        self.add("python3", STUB)

    def add(self, name: str, text: str) -> None:
        """Put a program on the PATH."""
        path = self.tools / name
        path.unlink(missing_ok=True)
        path.write_text(f"#!{shutil.which('bash')}\n{text}\n")
        path.chmod(0o755)

    def set_up(self, *arguments: str, code: int = 0, **variables: str) -> list[str]:
        """Run scripts/setup; return the calls of Python and uv, then the output."""
        self.notes.write_text("")
        env = {"PATH": str(self.tools), "HOME": "/nonexistent", "NOTES": str(self.notes)}
        command = [str(self.root / "scripts" / "setup"), *arguments]
        done = subprocess.run(
            command, check=False, env=env | variables, cwd="/", text=True, capture_output=True
        )
        assert done.returncode == code, done.stderr
        self.printed = done.stderr.splitlines()
        return [re.sub("pip .*--quiet ", "", line) for line in self.notes.read_text().splitlines()]


@pytest.fixture
def checkout(tmp_path: Path) -> Checkout:
    return Checkout(tmp_path)


def test_it_does_only_what_is_missing(checkout: Checkout) -> None:
    assert checkout.set_up() == FIRST
    assert checkout.set_up("--quiet") == []
    assert checkout.printed == []
    (checkout.root / "requirements.lock").write_text("other\n")
    assert checkout.set_up() == FIRST[1:]
    assert checkout.set_up("docs", "browser") == ["uv -e .[docs]", "uv --group browser"]
    assert checkout.set_up("docs") == []


def test_compiled_code_that_changed_is_compiled_again(checkout: Checkout) -> None:
    checkout.set_up()
    (checkout.root / "ros2_ws/src/needle_one/needle_one/fast.py").write_text("@compiled\n#\n")
    assert checkout.set_up() == []
    assert "setup: compiling numerical code" in checkout.printed


def test_another_place_or_python_needs_another_environment(checkout: Checkout) -> None:
    checkout.set_up()
    checkout.root = checkout.root.rename(checkout.root.with_name("moved"))
    assert checkout.set_up() == FIRST
    checkout.add("python3.13", 'PREFIX=/other exec python3 "$@"')
    assert checkout.set_up(NEEDLE_PYTHON="python3.13") == FIRST


def test_an_interrupted_set_up_is_done_again(checkout: Checkout) -> None:
    assert checkout.set_up(code=2, UV_CODE="1") == FIRST
    assert checkout.printed[-1].startswith("setup: could not install the packages")
    assert checkout.set_up() == FIRST


@pytest.mark.parametrize(
    ("stub", "text", "variables", "line"),
    [
        ("uname", "echo Linux aarch64", {}, "needs Linux on x86-64"),
        # A pyenv shim exists for versions that are not active.
        ("python3", "exit 127", {}, "no Python 3.10-3.13"),
        ("python3", "exit 0", {"NEEDLE_PYTHON": "/none/python"}, "or set NEEDLE_PYTHON"),
        ("ros2", "exit 0", {"ROS_DISTRO": "humble"}, "ROS 2 humble is sourced"),
    ],
)
def test_missing_requirements_are_reported_in_one_line(
    checkout: Checkout, stub: str, text: str, variables: dict[str, str], line: str
) -> None:
    checkout.add(stub, text)
    assert checkout.set_up(code=2, **variables) == []
    assert line in checkout.printed[0]
    assert len(checkout.printed) == 1


def test_sourced_ros_is_used_and_the_workspace_built(checkout: Checkout) -> None:
    (checkout.root / "requirements-apt.lock").touch()
    done = checkout.set_up(code=2, ROS_DISTRO="jazzy")
    assert done == ["venv", "uv -e . --group test --group apt"]
    # There is no colcon in this environment.
    assert "setup: building the workspace" in checkout.printed
