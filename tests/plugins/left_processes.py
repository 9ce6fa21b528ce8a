"""Processes that tests left: scripts/test tells them by a variable in their environment."""

from __future__ import annotations

import contextlib
import os
import signal
import time

from needle_bringup.workplace import processes_with

NAME = "NEEDLE_TEST_RUN"
RUN = os.environ.get(NAME, "")
# What was just told to end may need a moment [s].
PATIENCE = 2.0


def end_left_processes() -> list[str]:
    """End what this run started and did not end; return a line for each."""
    until = time.monotonic() + PATIENCE
    while (left := _left()) and time.monotonic() < until:
        time.sleep(0.05)
    for process, _ in left:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
    return [f"{process} {command}" for process, command in left]


def _left() -> list[tuple[int, str]]:
    """Return (pid, command) of what still runs; a zombie has no command, and is left out."""
    if not RUN:
        return []
    return [
        (process, command)
        for process, command in processes_with(NAME, RUN)
        if process != os.getpid() and command
    ]
