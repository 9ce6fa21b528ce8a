"""scripts/setup: what it leaves undone when it can, and repairs.

Of what it calls only pip, venv and colcon are replaced, so that no test downloads anything.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import pytest

import setup_workspace

Workspace = types.ModuleType


class Commands:
    """Stands in for pip, venv and colcon; remembers what was run."""

    def __init__(self, module: Workspace) -> None:
        self._module = module
        self.names: list[str] = []
        self.fail: dict[str, BaseException] = {}
        self.output = ""

    def __call__(self, command: list[Any], **_options: object) -> None:
        words = [str(word) for word in command]
        if "venv" in words or "pip" in words:
            name = "venv" if "venv" in words else "pip"
        else:
            name = "colcon" if "colcon_core" in words[2] else "import"
        if words[0] == "bash":
            name = "compile"
        self.names.append(name)
        if name in self.fail:
            self._module.LOG.write_text(self.output)
            raise self.fail[name]
        if name == "venv":
            (self._module.VENV / "bin").mkdir(parents=True)
            self._module.VENV_PYTHON.touch()
        if name == "colcon":
            for folder in ("build", "install"):
                (self._module.WORKSPACE / folder / "needle_one").mkdir(parents=True, exist_ok=True)


@pytest.fixture
def workspace(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> Workspace:
    """Return the module, at work in the checkout of this test."""
    module: Workspace = setup_workspace
    root = module.ROOT
    for name, value in vars(module).copy().items():
        if isinstance(value, Path) and value.is_relative_to(root):
            monkeypatch.setattr(module, name, checkout / value.relative_to(root))
    locks = {mode: checkout / path.name for mode, path in module.LOCKS.items()}
    monkeypatch.setattr(module, "LOCKS", locks)
    monkeypatch.setattr(sys, "argv", ["scripts/setup"])
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    return module


@pytest.fixture
def commands(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> Commands:
    commands = Commands(workspace)
    monkeypatch.setattr(workspace, "run", commands)
    return commands


BUILD = ["colcon", "compile"]
FIRST = ["venv", "pip", "pip", "import", *BUILD]


def test_a_second_set_up_does_nothing(workspace: Workspace, commands: Commands) -> None:
    assert workspace.main() == 0
    assert commands.names == FIRST
    commands.names.clear()
    assert workspace.main() == 0
    assert commands.names == []


@pytest.mark.parametrize(
    ("file", "text", "done"),
    [
        ("requirements.lock", "setuptools==2 \\\n    --hash=sha256:0\n", FIRST[1:]),
        ("ros2_ws/src/needle_one/needle_one/executables.py", "new", ["colcon"]),
        ("ros2_ws/src/needle_one/launch/rig.launch.py", "new", ["colcon"]),
        (
            "ros2_ws/src/needle_one/needle_one/fast.py",
            "from x import compiled\n\n@compiled\ndef f(): ...\n",
            ["compile"],
        ),
        # What is linked needs no build.
        ("ros2_ws/src/needle_one/config/rig.yaml", "a: 2", []),
        ("ros2_ws/src/needle_one/needle_one/plant.py", "", []),
    ],
)
def test_only_what_a_change_needs_is_done_and_once(
    checkout: Path, workspace: Workspace, commands: Commands, file: str, text: str, done: list[str]
) -> None:
    (checkout / "ros2_ws/src/needle_one/config/rig.yaml").write_text("a: 1")
    workspace.main()
    (checkout / file).parent.mkdir(exist_ok=True)
    (checkout / file).write_text(text)
    for wanted in (done, []):
        commands.names.clear()
        assert workspace.main() == 0
        assert commands.names == wanted


@pytest.mark.parametrize(("stage", "again"), [("pip", FIRST), ("import", FIRST), ("colcon", BUILD)])
def test_the_next_set_up_repairs_an_interrupted_one(
    workspace: Workspace, commands: Commands, stage: str, again: list[str]
) -> None:
    commands.fail[stage] = KeyboardInterrupt()
    assert workspace.main() == 130
    commands.fail.clear()
    commands.names.clear()
    assert workspace.main() == 0
    assert commands.names == again


def test_a_moved_checkout_gets_a_new_environment(
    workspace: Workspace, commands: Commands, monkeypatch: pytest.MonkeyPatch
) -> None:
    workspace.main()
    commands.names.clear()
    monkeypatch.setattr(workspace, "ROOT", Path("/elsewhere"))
    monkeypatch.setattr(workspace, "check_space", lambda _folder: None)
    monkeypatch.setattr(workspace, "exclusive", lambda: contextlib.nullcontext(-1))
    assert workspace.main() == 0
    assert commands.names == FIRST


@pytest.mark.parametrize(
    ("output", "line"),
    [
        ("ERROR: [Errno 28] No space left on device", "disk full"),
        (
            "WARNING: Retrying (Retry(total=0))\nERROR: No matching distribution found for a",
            "no network",
        ),
        ("ERROR: No matching distribution found for a==1", "the package index has no a==1"),
        ("ERROR: THESE PACKAGES DO NOT MATCH THE HASHES FROM", "another file than the lock pins"),
        ("strange", "could not install the packages; all output is in "),
    ],
)
def test_a_failed_installation_says_why_in_one_line(
    workspace: Workspace,
    commands: Commands,
    capsys: pytest.CaptureFixture[str],
    output: str,
    line: str,
) -> None:
    commands.fail["pip"] = workspace.CommandFailedError()
    commands.output = f"$ pip install\n{output}\n"
    assert workspace.main() == 2
    assert line in capsys.readouterr().err.splitlines()[-1]


def test_too_little_space_is_said_before_anything_is_done(
    workspace: Workspace,
    commands: Commands,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    free = shutil.disk_usage("/")._replace(free=700_000_000)
    monkeypatch.setattr(workspace.shutil, "disk_usage", lambda _path: free)
    assert workspace.main() == 2
    assert "has 0.7 GB free, needs 1.8 GB" in capsys.readouterr().err.splitlines()[-1]
    assert commands.names == []


def test_executables_run_from_a_path_with_a_space_and_old_ones_go(workspace: Workspace) -> None:
    python = workspace.VENV_PYTHON
    python.parent.mkdir(parents=True)
    python.symlink_to(sys.executable)
    folder = workspace.WORKSPACE / "install" / "needle_one" / "lib" / "needle_one"
    build = workspace.WORKSPACE / "build" / "needle_one"
    egg = build / "needle_one.egg-info"
    folder.mkdir(parents=True)
    egg.mkdir(parents=True)
    (egg / "entry_points.txt").write_text("[console_scripts]\nkept = kept_one:main\n")
    (build / "kept_one.py").write_text(
        "import sys\n"
        "def main(): print('importlib.metadata' in sys.modules, *sys.argv[1:]); return 3\n"
    )
    for name in ("kept", "gone"):
        (folder / name).write_text("#!/nowhere\n")
        (folder / name).chmod(0o755)
    workspace.tidy_executables("needle_one")
    workspace.tidy_executables("needle_one")
    assert [path.name for path in folder.iterdir()] == ["kept"]
    done = subprocess.run(
        [folder / "kept", "a b"],
        env={**os.environ, "PYTHONPATH": str(build)},
        capture_output=True,
        check=False,
        text=True,
    )
    # Nobody waits for a look into the package's metadata.
    assert (done.stdout, done.returncode) == ("False a b\n", 3), done.stderr
