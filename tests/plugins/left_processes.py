"""Processes that tests left: scripts/test tells them by a variable in their environment."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

RUN = os.environ.get("NEEDLE_TEST_RUN", "")
# What was just told to end may need a moment [s].
PATIENCE = 2.0


def end_left_processes() -> list[str]:
    """End what this run started and did not end; return a line for each."""
    until = time.monotonic() + PATIENCE
    while (left := _processes_of_run()) and time.monotonic() < until:
        time.sleep(0.05)
    for process in left:
        try:
            os.kill(process, signal.SIGKILL)
        except ProcessLookupError:
            continue
    return [f"{process} {command}" for process, command in left.items()]


def _processes_of_run() -> dict[int, str]:
    found: dict[int, str] = {}
    if not RUN:
        return found
    mark = f"NEEDLE_TEST_RUN={RUN}".encode()
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if int(folder.name) == os.getpid() or mark not in (
                (folder / "environ").read_bytes().split(b"\0")
            ):
                continue
            command = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode().strip()
        except OSError:
            continue
        if command:
            found[int(folder.name)] = command
    return found
