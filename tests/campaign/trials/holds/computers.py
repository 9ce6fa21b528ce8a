"""Two virtual computers of a trial, and the cable between them. Imports no ROS."""

from __future__ import annotations

import collections
import contextlib
import ctypes
import fcntl
import multiprocessing
import os
import random
import select
import struct
import subprocess
import time
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection

from needle_core.errors import UserError

ADDRESSES = ("10.213.78.1", "10.213.78.2")
_LIBC = ctypes.CDLL(None, use_errno=True)
# Separate shared memory too, which would bypass the cable. It lasts until its stdin closes.
_LIVE = "mount -t tmpfs shm /dev/shm && ip link set lo up && echo ready && exec cat"
# linux/if_tun.h: plain Ethernet frames.
_TUN, _TUNSETIFF, _IFF_TAP, _IFF_NO_PI = "/dev/net/tun", 0x400454CA, 0x0002, 0x1000
_LONGEST_FRAME = 65536


def enter_network(pid: int) -> None:
    """Move this thread, and processes it starts later, into the network of a process.

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
    """A separate network and shared memory."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            ["unshare", "--net", "--mount", "sh", "-c", _LIVE],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        assert self._process.stdout is not None
        if not self._process.stdout.readline():
            raise UserError("no second computer can be made here: it takes root and iproute2")
        self.pid = self._process.pid
        self.inside = ("nsenter", "--target", str(self.pid), "--net", "--mount", "--")
        """Command prefix that runs a command on this computer."""

    def run(self, words: str) -> None:
        """Run a command on this computer; raises CalledProcessError if it fails."""
        subprocess.run([*self.inside, *words.split()], check=True)

    def close(self) -> None:
        """Close it; it ends with its last process."""
        self._process.communicate()


class Cable:
    """Cable between two computers with the addresses `ADDRESSES`.

    Parameters
    ----------
    computers : sequence of Computer
        Both computers.
    delay : float
        Delay of a frame [s].
    loss : float
        Share of lost frames.
    """

    def __init__(
        self, computers: Sequence[Computer], *, delay: float = 0.0, loss: float = 0.0
    ) -> None:
        context = multiprocessing.get_context("spawn")
        self._orders, orders = context.Pipe()
        pids = [computer.pid for computer in computers]
        self._process = context.Process(target=_be_cable, args=(orders, pids, delay, loss))
        self._process.start()
        orders.close()
        self._orders.recv()
        for computer, address in zip(computers, ADDRESSES, strict=True):
            computer.run(f"ip addr add {address}/24 dev cable0")
            computer.run("ip link set cable0 up")

    def cut(self) -> None:
        """Drop all frames, also those in transit."""
        self._order(True)

    def mend(self) -> None:
        """Transmit frames again."""
        self._order(False)

    def close(self) -> None:
        """Remove it."""
        self._orders.close()
        self._process.join()

    def _order(self, cut: bool) -> None:
        self._orders.send(cut)
        self._orders.recv()


@contextlib.contextmanager
def two_computers(
    *, delay: float = 0.0, loss: float = 0.0
) -> Iterator[tuple[Computer, Computer, Cable]]:
    """Make two computers with a cable between them."""
    with (
        contextlib.closing(Computer()) as one,
        contextlib.closing(Computer()) as other,
        contextlib.closing(Cable((one, other), delay=delay, loss=loss)) as cable,
    ):
        yield one, other, cable


def _be_cable(orders: Connection, pids: Sequence[int], delay: float, loss: float) -> None:
    """Forward frames until the orders end."""
    ends = [_plug(pid) for pid in pids]
    orders.send(None)
    draw, is_cut = random.Random(1), False
    under_way: collections.deque[tuple[float, int, bytes]] = collections.deque()
    poll = select.epoll()
    for file in (*ends, orders.fileno()):
        poll.register(file, select.EPOLLIN)
    while True:
        now = time.monotonic()
        while under_way and under_way[0][0] <= now:
            _, to, frame = under_way.popleft()
            # The frame is lost if the receiver's queue is full or its interface is down.
            with contextlib.suppress(OSError):
                os.write(ends[to], frame)
        for file, _ in poll.poll(max(under_way[0][0] - now, 0.0) if under_way else -1):
            if file == orders.fileno():
                try:
                    is_cut = orders.recv()
                except EOFError:
                    return
                under_way.clear()
                orders.send(None)
                continue
            with contextlib.suppress(BlockingIOError):
                while frame := os.read(file, _LONGEST_FRAME):
                    if not (is_cut or draw.random() < loss):
                        under_way.append((time.monotonic() + delay, 1 - ends.index(file), frame))


def _plug(pid: int) -> int:
    """Return the file descriptor of a new interface in the network of a process."""
    enter_network(pid)
    file = os.open(_TUN, os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(file, _TUNSETIFF, struct.pack("16sH", b"cable0", _IFF_TAP | _IFF_NO_PI))
    return file
