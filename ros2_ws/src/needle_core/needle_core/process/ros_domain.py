"""A ROS domain that nobody else on this machine uses."""

from __future__ import annotations

import random
import socket
from collections.abc import Iterator
from contextlib import contextmanager

from needle_core.errors import UserError
from needle_core.process.shared_memory import remove_dead_ports, remove_half_made_ports

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
def own_domain() -> Iterator[int]:
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
                remove_half_made_ports()
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
