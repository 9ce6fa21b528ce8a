"""Names that only one process of a machine holds, among them a ROS domain."""

from __future__ import annotations

import hashlib
import os
import random
import socket
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from needle_core.errors import UserError
from needle_core.process.shared_memory import remove_dead_ports, remove_incomplete_ports

# What to do about two that may not be in one graph.
CONFLICT_HINT = "end one of the two, or give one a ROS_DOMAIN_ID of its own"
# Of an abstract socket's name [bytes].
_LONGEST = 107
_NAMES = Path("/proc/net/unix")


class Claim:
    """Holds a name until it is released or collected, or the process ends.

    Parameters
    ----------
    name : str
        What is claimed.
    holder : str
        Who claims it, for whoever comes second.

    Raises
    ------
    UserError
        If another has it: says who.
    """

    def __init__(self, name: str, holder: str) -> None:
        key = f"needle_{hashlib.sha256(name.encode()).hexdigest()[:24]}"
        claimed = _bound(key)
        if claimed is None:
            raise UserError(f"{_holder_of(key)} has {name}")
        # The kernel lists the names of all sockets: this one says who it is.
        label = _bound(f"{key}:{holder} (process {os.getpid()})")
        self._release = weakref.finalize(self, _close, claimed, label)

    def release(self) -> None:
        """Let go of the name; more than once does no harm."""
        self._release()


def _bound(name: str) -> int | None:
    """Return an open file that has the name; None where another has it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as one:
        try:
            one.bind(b"\0" + name.encode()[: _LONGEST - 1])
        except OSError:
            return None
        return one.detach()


def _close(*files: int | None) -> None:
    for file in files:
        if file is not None:
            os.close(file)


def _holder_of(key: str) -> str:
    try:
        lines = _NAMES.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    labels = [line.partition(f"@{key}:")[2].strip() for line in lines]
    return next(filter(None, labels), "another process")


# Above 101 the ports reach into the range that Linux gives out to outgoing connections; 0 is where
# everything runs that was not told otherwise.
DOMAINS = range(1, 100)
# RTPS: port of the first participant's discovery in a domain.
PORT_BASE = 7400
PORTS_PER_DOMAIN = 250
FIRST_PARTICIPANT = 10
# Of a domain's participants, those that are looked for: the first may have gone, others not.
PARTICIPANTS = 40


@contextmanager
def reserve_domain_id() -> Iterator[int]:
    """Reserve a ROS_DOMAIN_ID for as long as the context lasts.

    Two holders never get the same: each binds a socket name for its domain, which the kernel frees
    whatever becomes of the holder. A domain where a foreign node listens is passed over.
    Shared-memory ports that killed processes left in it are taken away before and after.

    Raises
    ------
    UserError
        If all are taken.
    """
    candidates = list(DOMAINS)
    random.shuffle(candidates)
    for domain in candidates:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as lock:
            if _binds(lock, f"\0needle_ros_domain_{domain}") and _is_silent(domain):
                remove_dead_ports(ports_of(domain))
                remove_incomplete_ports()
                try:
                    yield domain
                finally:
                    remove_dead_ports(ports_of(domain))
                return
    raise UserError("no free ROS_DOMAIN_ID on this machine: is anything left running?")


def ports_of(domain: int) -> range:
    """Return the ports that a domain's participants listen on."""
    first = PORT_BASE + PORTS_PER_DOMAIN * domain
    return range(first, first + PORTS_PER_DOMAIN)


def _is_silent(domain: int) -> bool:
    ports = ports_of(domain)[FIRST_PARTICIPANT : FIRST_PARTICIPANT + 2 * PARTICIPANTS : 2]
    for port in ports:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            if not _binds(probe, ("", port)):
                return False
    return True


def _binds(one: socket.socket, address: str | tuple[str, int]) -> bool:
    try:
        one.bind(address)
    except OSError:
        return False
    return True
