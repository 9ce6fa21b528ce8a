"""Names that only one process per machine can hold, such as a ROS domain."""

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

# Hint shown when two devices conflict.
CONFLICT_HINT = "stop one of the two, or give one its own ROS_DOMAIN_ID"
# Length of an abstract socket's name [bytes].
_MAX_NAME = 107
_NAMES = Path("/proc/net/unix")


class Claim:
    """Exclusive name on this machine, until it is released or collected, or the process ends.

    Discovery may take seconds, so two processes that start together have not discovered each other
    yet. A socket name is exclusive at once, and free as soon as its process ends.

    Parameters
    ----------
    name : str
        Name to claim.
    holder : str
        Name of the holder, for the error messages of other processes.

    Raises
    ------
    UserError
        If another process holds it; the message names the holder.
    """

    def __init__(self, name: str, holder: str) -> None:
        key = f"needle_{hashlib.sha256(name.encode()).hexdigest()[:24]}"
        claimed = _bound(key)
        if claimed is None:
            raise UserError(f"{_holder_of(key)} has {name}")
        # The kernel lists the names of all sockets, so a second one can show who holds the first.
        label = _bound(f"{key}:{holder} (process {os.getpid()})")
        self._release = weakref.finalize(self, _close, claimed, label)

    def release(self) -> None:
        """Release the name; repeated calls have no effect."""
        self._release()


def _bound(name: str) -> int | None:
    """Return a bound socket's file descriptor; None if another process holds the name."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as one:
        try:
            one.bind(b"\0" + name.encode()[: _MAX_NAME - 1])
        except OSError:
            return None
        return one.detach()


def _close(*files: int | None) -> None:
    for file in files:
        if file is not None:
            os.close(file)


def _holder_of(key: str) -> str:
    lines = _NAMES.read_text(encoding="utf-8", errors="replace").splitlines()
    labels = [line.partition(f"@{key}:")[2].strip() for line in lines]
    return next(filter(None, labels), "another process")


# 0 is the default domain; above 101, ports overlap with those of outgoing connections in Linux.
DOMAINS = range(1, 100)
# RTPS: discovery port of the first participant in domain 0.
PORT_BASE = 7400
PORTS_PER_DOMAIN = 250
FIRST_PARTICIPANT = 10
# Number of participants to probe for: the first ones may have ended before the others.
PARTICIPANTS = 40


@contextmanager
def reserve_domain_id() -> Iterator[int]:
    """Reserve a ROS_DOMAIN_ID within a `with` block.

    Each holder binds a socket name for its domain, which the kernel frees when the process ends. A
    domain with a listening node is skipped. Shared-memory ports that killed processes left in the
    domain are removed before and after.

    Raises
    ------
    UserError
        If all domains are in use.
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
    raise UserError("no free ROS_DOMAIN_ID on this machine: check for processes left running")


def ports_of(domain: int) -> range:
    """Return the port numbers of a domain."""
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
