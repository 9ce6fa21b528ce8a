"""Checkout, work folders and child processes of `verify`, `paper` and other commands."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import tempfile
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from needle_core.errors import UserError

_GRACE = 10.0
_POLL = 0.05


def checkout() -> Path:
    """Return the checkout that contains this code.

    Raises
    ------
    UserError
        If there is none, because the package is installed.
    """
    for folder in Path(__file__).resolve().parents:
        if (folder / "scripts" / "simulate").is_file():
            return folder
    raise UserError("this runs from a checkout only: scripts/simulate is missing")


def make_folder(option: str, name: str, *, exist_ok: bool = True) -> Path:
    """Return the folder given to an option, created if missing.

    Raises
    ------
    UserError
        If it cannot be created, or exists and `exist_ok` is False.
    """
    folder = Path(name).expanduser().absolute()
    try:
        folder.mkdir(parents=True, exist_ok=exist_ok)
    except OSError as error:
        raise UserError(f"{option} {name}: {error.strerror}") from error
    return folder


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """Create a folder; remove it at the end, but not after a `UserError`, which may name a log."""
    folder = Path(tempfile.mkdtemp(prefix="needle_work_"))
    try:
        yield folder
    except UserError:
        raise
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    shutil.rmtree(folder, ignore_errors=True)


def processes_with(name: str, value: str) -> list[tuple[int, str]]:
    """Return (pid, command) of the processes with this environment variable."""
    variable = f"{name}={value}".encode()
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            if variable in (entry / "environ").read_bytes().split(b"\0"):
                command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
                found.append((int(entry.name), command.strip()))
        except OSError:
            continue  # the process has ended, or belongs to another user
    return found


def ran(
    command: Sequence[str],
    good: Sequence[int] = (0,),
    *,
    environment: Mapping[str, str] | None = None,
    what: str = "",
) -> subprocess.CompletedProcess[str]:
    """Run a command; return its output and exit code.

    Parameters
    ----------
    command : sequence of str
        The command line.
    good : sequence of int
        Accepted exit codes.
    environment : mapping, optional
        Environment of the command; by default that of this process.
    what : str
        Name for the error message.

    Raises
    ------
    UserError
        If the exit code is not accepted; the message includes the last line of output.
    """
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode not in good:
        last = (done.stderr.strip() or done.stdout.strip() or "no output").splitlines()[-1]
        name = f"{what}: {Path(command[0]).name}" if what else " ".join(command)
        raise UserError(f"{name} ended with code {done.returncode}: {last}")
    return done


@contextlib.contextmanager
def ending_descendants() -> Iterator[None]:
    """End all descendants that were started within a `with` block, by SIGTERM, then SIGKILL.

    They are identified by an environment variable, even in sessions of their own.
    """
    name, value = f"NEEDLE_STARTED_BY_{os.getpid()}", uuid.uuid4().hex
    os.environ[name] = value
    try:
        yield
    finally:
        del os.environ[name]
        _send(name, value, signal.SIGTERM)
        until = time.monotonic() + _GRACE
        while processes_with(name, value) and time.monotonic() < until:
            time.sleep(_POLL)
        _send(name, value, signal.SIGKILL)


def _send(name: str, value: str, number: signal.Signals) -> None:
    for pid, _ in processes_with(name, value):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)
