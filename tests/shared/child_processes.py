"""Child processes of `verify`, `bench` and the test runner."""

from __future__ import annotations

import contextlib
import os
import signal
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

_GRACE = 10.0
_POLL = 0.05


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
