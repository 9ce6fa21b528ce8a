"""Processes of a command: their end is reported in one line, and nothing of them is left."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path

import pytest

from needle_bringup import workplace
from needle_bringup.workplace import ending_descendants, make_folder, ran, temporary_folder
from needle_core.errors import UserError


def test_descendants_are_terminated_then_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    alive, sent = {1: "orderly", 2: "stubborn"}, []
    now = iter(range(0, 1000, 4))

    def kill(pid: int, number: int) -> None:
        sent.append((pid, number))
        if pid == 1 or number == signal.SIGKILL:
            del alive[pid]

    def found(name: str, value: str) -> list[tuple[int, str]]:
        assert name == f"NEEDLE_STARTED_BY_{os.getpid()}"
        assert len(value) == 32
        return list(alive.items())

    monkeypatch.setattr(workplace, "processes_with", found)
    monkeypatch.setattr(os, "kill", kill)
    monkeypatch.setattr("time.monotonic", lambda: next(now))
    monkeypatch.setattr("time.sleep", lambda _: None)
    with pytest.raises(KeyboardInterrupt), ending_descendants():
        assert f"NEEDLE_STARTED_BY_{os.getpid()}" in os.environ
        raise KeyboardInterrupt
    assert sent == [(1, signal.SIGTERM), (2, signal.SIGTERM), (2, signal.SIGKILL)]
    assert f"NEEDLE_STARTED_BY_{os.getpid()}" not in os.environ


def test_a_failed_command_is_reported_with_its_last_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(command, 2, "done\n", "one\nno rig\n")

    monkeypatch.setattr(subprocess, "run", run)
    assert ran(["/bin/simulate"], (0, 2)).stdout == "done\n"
    with pytest.raises(UserError, match=r"^trial_1: simulate ended with code 2: no rig$"):
        ran(["/bin/simulate"], what="trial_1")


def test_a_folder_is_kept_if_an_error_may_name_a_log_in_it(tmp_path: Path) -> None:
    for error, left in ((None, False), (KeyboardInterrupt(), False), (UserError("log"), True)):
        folders = []
        try:
            with temporary_folder() as folder:
                folders.append(folder)
                if error is not None:
                    raise error
        except (KeyboardInterrupt, UserError):
            pass
        assert folders[0].exists() is left
        if left:
            folders[0].rmdir()
    assert make_folder("--out", str(tmp_path / "new" / "one")).is_dir()
    with pytest.raises(UserError, match=r"--out .*: File exists"):
        make_folder("--out", str(tmp_path), exist_ok=False)
