"""Computers of a trial: each has a network and shared memory of its own. No ROS in here."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from collections.abc import Sequence

from needle_core.errors import UserError

ADDRESSES = ("10.213.78.1", "10.213.78.2")
_LIBC = ctypes.CDLL(None, use_errno=True)
_TOOLS = ("ip", "unshare", "nsenter")
_CABLE = "campaign.trials.computers.bad_cable"
# Shared memory, too: through it nodes of one machine would go on talking beside the cable. It
# lasts as long as its input, and so no longer than this process.
_LIVE = "mount -t tmpfs shm /dev/shm && ip link set lo up && echo ready && exec cat"


def enter_network(pid: int) -> None:
    """Put this thread, and all that it starts from now on, into the network of a process.

    Raises
    ------
    UserError
        If the kernel refuses.
    """
    file = os.open(f"/proc/{pid}/ns/net", os.O_RDONLY)
    refused = _LIBC.setns(file, 0)
    os.close(file)
    if refused:
        raise UserError(f"the network of process {pid}: {os.strerror(ctypes.get_errno())}")


class Computer:
    """A network and shared memory that no other process of this machine sees."""

    def __init__(self) -> None:
        self._holder = _started(["unshare", "--net", "--mount", "sh", "-c", _LIVE])

    @property
    def pid(self) -> int:
        """A process that is in it; who enters its network alone keeps this machine's memory."""
        return self._holder.pid

    @property
    def inside(self) -> tuple[str, ...]:
        """Words before a command that run it there."""
        return ("nsenter", "--target", str(self.pid), "--net", "--mount", "--")

    def run(self, *words: str) -> None:
        """Run a command there to its end.

        Raises
        ------
        UserError
            If it fails.
        """
        done = subprocess.run([*self.inside, *words], capture_output=True, text=True, check=False)
        if done.returncode:
            raise UserError(f"{' '.join(words)}: {done.stderr.strip()}")

    def close(self) -> None:
        """Let it go; it ends with the last process in it."""
        _end(self._holder)


class Cable:
    """The cable between two computers.

    Parameters
    ----------
    computers : sequence of Computer
        The two; they get the addresses of `ADDRESSES`.
    delay : float
        Time that a frame takes [s].
    loss : float
        Share of frames that never arrive.
    seed : int
        Of those.
    """

    def __init__(
        self, computers: Sequence[Computer], *, delay: float, loss: float, seed: int
    ) -> None:
        pids = [str(computer.pid) for computer in computers]
        numbers = ["--delay", str(delay), "--loss", str(loss), "--seed", str(seed)]
        self._process = _started([sys.executable, "-m", _CABLE, *pids, *numbers])
        try:
            for computer, address in zip(computers, ADDRESSES, strict=True):
                computer.run("ip", "addr", "add", f"{address}/24", "dev", "cable0")
                computer.run("ip", "link", "set", "cable0", "up")
        except UserError:
            self.close()
            raise

    def cut(self) -> float:
        """Cut it; return when it was [s on the steady clock]."""
        return self._order("cut")

    def mend(self) -> float:
        """Mend it; return when it was [s on the steady clock]."""
        return self._order("mend")

    def close(self) -> None:
        """Take it away."""
        _end(self._process)

    def _order(self, word: str) -> float:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{word}\n")
        self._process.stdin.flush()
        return float(self._process.stdout.readline())


def _started(command: Sequence[str]) -> subprocess.Popen[str]:
    """Start a helper that says `ready`, and ends with its input."""
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    if process.stdout.readline().strip() == "ready":
        return process
    assert process.stderr is not None
    said = process.stderr.read().strip().splitlines()
    _end(process)
    raise UserError(f"no second computer can be made here: {said[-1] if said else command[0]}")


def _end(process: subprocess.Popen[str]) -> None:
    for stream in (process.stdin, process.stdout, process.stderr):
        if stream is not None:
            stream.close()
    process.wait()
