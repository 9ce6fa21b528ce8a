"""A node as a process of its own: started, watched, and ended whatever it takes."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

INTERRUPT_GRACE = 5.0
TERMINATE_GRACE = 3.0
# The recorder writes out what it still holds: a slow disk may take its time.
RECORDER_GRACE = 30.0
POLL = 0.01
_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None, use_errno=True)


class NodeProcess:
    """One process in a session of its own.

    It ends with its parent even when that one is killed outright.

    Parameters
    ----------
    name : str
        The node's name.
    command : sequence of str
        What to run.
    environment : mapping
        Its whole environment.
    log : Path
        File that takes its output.
    pass_fds : sequence of int
        Open files that it keeps.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        *,
        environment: Mapping[str, str],
        log: Path,
        pass_fds: Sequence[int] = (),
    ) -> None:
        self.name = name
        self.log = log
        parent = os.getpid()

        def end_with_parent() -> None:
            _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
            if os.getppid() != parent:
                os._exit(1)

        with log.open("ab") as output:
            self._process = subprocess.Popen(
                list(command),
                env=dict(environment),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                pass_fds=pass_fds,
                start_new_session=True,
                preexec_fn=end_with_parent,  # noqa: PLW1509
            )

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def exit_code(self) -> int | None:
        """Exit code, negative for a signal; None while it runs."""
        return self._process.poll()

    @property
    def last_line(self) -> str:
        """Last line that it wrote, or an empty text."""
        said = [line.strip() for line in self.tail(20) if line.strip()]
        return said[-1] if said else ""

    def tail(self, count: int) -> list[str]:
        """Return the last `count` lines that it wrote."""
        try:
            lines = self.log.read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError:
            return []
        return lines[-count:]

    def describe_end(self) -> str:
        """Say in words how it ended."""
        code = self.exit_code
        if code is None:
            return f"{self.name} runs"
        how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        said = self.last_line.removeprefix("error: ")
        return f"{self.name} ended with {how}" + (f": {said}" if said else "")

    def signal_group(self, number: signal.Signals) -> None:
        """Send a signal to the process and whatever it started."""
        try:
            os.killpg(self._process.pid, number)
        except ProcessLookupError:
            return


def wait_for(processes: Iterable[NodeProcess], timeout: float) -> list[NodeProcess]:
    """Wait up to `timeout` [s] for all to end; return those that have not."""
    deadline = time.monotonic() + timeout
    running = list(processes)
    while True:
        running = [process for process in running if process.exit_code is None]
        if not running or time.monotonic() >= deadline:
            return running
        time.sleep(POLL)


def stop(processes: Iterable[NodeProcess], grace: float = INTERRUPT_GRACE) -> list[str]:
    """End all: SIGINT, then SIGTERM, then SIGKILL; return a warning for each that needed more.

    Parameters
    ----------
    processes : iterable of NodeProcess
        Those to end, all at once; ones that have ended are fine.
    grace : float
        How long an orderly end may take [s].
    """
    started = list(processes)
    running = [process for process in started if process.exit_code is None]
    for process in running:
        process.signal_group(signal.SIGINT)
    running = wait_for(running, grace)
    for process in running:
        process.signal_group(signal.SIGTERM)
    stubborn = wait_for(running, TERMINATE_GRACE)
    for process in started:
        # Also what a process that has ended left behind in its group.
        process.signal_group(signal.SIGKILL)
    wait_for(stubborn, TERMINATE_GRACE)
    return [f"{process.name} did not end on SIGINT and SIGTERM, killed" for process in stubborn]
