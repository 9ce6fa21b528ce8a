"""Processes that a command starts, and what they start: none outlives it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from needle_core.errors import UserError

_GRACE = 10.0
_POLL = 0.05


def processes_with(name: str, value: str) -> list[tuple[int, str]]:
    """Return (pid, command) of every process with a variable of this value in its environment."""
    wanted = f"{name}={value}".encode()
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            if wanted in (entry / "environ").read_bytes().split(b"\0"):
                command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
                found.append((int(entry.name), command.strip()))
        except OSError:
            continue  # ended meanwhile, or another user's
    return found


def ran(
    command: Sequence[str],
    good: Sequence[int] = (0,),
    *,
    environment: Mapping[str, str] | None = None,
    what: str = "",
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end; return its output and exit code.

    Parameters
    ----------
    command : sequence of str
        The command line.
    good : sequence of int
        Exit codes that are no error.
    environment : mapping, optional
        In place of this process' own.
    what : str
        Name of it all for an error.

    Raises
    ------
    UserError
        If the code is none of the good ones, with the last that it said.
    """
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode not in good:
        last = (done.stderr.strip() or done.stdout.strip() or "it said nothing").splitlines()[-1]
        name = f"{what}: {Path(command[0]).name}" if what else " ".join(command)
        raise UserError(f"{name} ended with code {done.returncode}: {last}")
    return done


@contextlib.contextmanager
def ending_descendants() -> Iterator[None]:
    """End all processes that were started within a `with` block, whoever started them and how.

    They are told by a variable in their environment, which a session of their own does not hide;
    first by SIGTERM, and after 10 s by SIGKILL.
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
