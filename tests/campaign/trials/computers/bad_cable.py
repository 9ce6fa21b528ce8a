"""A cable between two networks of this machine: it delays, loses, and can be cut. No ROS in here.

`python -m campaign.trials.computers.bad_cable PID PID --delay 0.005 --loss 0.01` plugs a
network interface `cable0` into the network of each of the two processes and hands on what is sent
between them until its input ends. It says `ready` when both are plugged in; the lines `cut` and
`mend` are answered by the time at which they were obeyed (steady clock) [s].
"""

from __future__ import annotations

import collections
import contextlib
import fcntl
import os
import random
import select
import struct
import sys
import time

from campaign.trials.computers.namespaces import enter_network
from needle_core.commands.cli import EXIT_DONE, run_command
from needle_core.commands.options import CommandParser
from needle_core.errors import UserError

INTERFACE = "cable0"
_TUN = "/dev/net/tun"
# linux/if_tun.h: frames as they are on an Ethernet, nothing before them.
_TUNSETIFF, _IFF_TAP, _IFF_NO_PI = 0x400454CA, 0x0002, 0x1000
_LONGEST_FRAME = 65536


class BadCable:
    """Frames on their way between two ends.

    Parameters
    ----------
    delay : float
        How long a frame takes [s].
    loss : float
        Share of the frames that never arrive.
    seed : int
        Of those.
    """

    def __init__(self, delay: float, loss: float, seed: int) -> None:
        self._delay = delay
        self._loss = loss
        self._draw = random.Random(seed)
        self._under_way: collections.deque[tuple[float, int, bytes]] = collections.deque()
        self._is_cut = False

    def cut(self) -> None:
        """Let nothing through, nor what is on its way."""
        self._is_cut = True
        self._under_way.clear()

    def mend(self) -> None:
        """Let through what is sent from now on."""
        self._is_cut = False

    def send(self, frame: bytes, to: int, now: float) -> None:
        """Take a frame at a time [s] to an end of this number."""
        if not (self._is_cut or self._draw.random() < self._loss):
            self._under_way.append((now + self._delay, to, frame))

    def wait(self, now: float) -> float | None:
        """Return how long there is nothing to deliver [s]; None: nothing is on its way."""
        return max(self._under_way[0][0] - now, 0.0) if self._under_way else None

    def arrived(self, now: float) -> list[tuple[int, bytes]]:
        """Return (end, frame) of all that have arrived by a time [s], in their order."""
        frames = []
        while self._under_way and self._under_way[0][0] <= now:
            _, to, frame = self._under_way.popleft()
            frames.append((to, frame))
        return frames


def _plug(pid: int) -> int:
    """Return the file of a new interface in the network of a process."""
    enter_network(pid)
    try:
        file = os.open(_TUN, os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(
            file, _TUNSETIFF, struct.pack("16sH", INTERFACE.encode(), _IFF_TAP | _IFF_NO_PI)
        )
    except OSError as error:
        raise UserError(f"{_TUN}: no network interface can be made: {error.strerror}") from error
    return file


def _hand_on(cable: BadCable, ends: tuple[int, int], orders: int) -> None:
    """Hand on frames until the orders end."""
    poll = select.epoll()
    for file in (*ends, orders):
        poll.register(file, select.EPOLLIN)
    while True:
        now = time.monotonic()
        for to, frame in cable.arrived(now):
            _write(ends[to], frame)
        wait = cable.wait(now)
        for file, _ in poll.poll(-1 if wait is None else wait):
            if file == orders:
                words = os.read(orders, 64).decode().split()
                if not words:
                    return
                for word in words:
                    (cable.cut if word == "cut" else cable.mend)()
                    print(f"{time.monotonic():.6f}", flush=True)
                continue
            to = 1 - ends.index(file)
            while frame := _read(file):
                cable.send(frame, to, time.monotonic())


def _read(file: int) -> bytes:
    try:
        return os.read(file, _LONGEST_FRAME)
    except BlockingIOError:
        return b""


def _write(file: int, frame: bytes) -> None:
    # Lost, as where a receiver's queue is full, or its interface still down.
    with contextlib.suppress(OSError):
        os.write(file, frame)


def main() -> int:
    """Be a cable; returns the exit code."""
    parser = CommandParser("bad_cable", __doc__ or "", "")
    parser.add_argument("pids", type=int, nargs=2, metavar="PID", help="in whose network")
    parser.add_argument("--delay", type=float, default=0.0, help="of every frame [s]")
    parser.add_argument("--loss", type=float, default=0.0, help="share of frames, 0..1")
    parser.add_argument("--seed", type=int, default=1)

    def run() -> int:
        given = parser.parse_args()
        first, second = (_plug(pid) for pid in given.pids)
        print("ready", flush=True)
        cable = BadCable(given.delay, given.loss, given.seed)
        _hand_on(cable, (first, second), sys.stdin.fileno())
        return EXIT_DONE

    return run_command(run)


if __name__ == "__main__":
    sys.exit(main())
