"""A ROS domain that nobody else on this machine uses."""

from __future__ import annotations

import fcntl
import os
import random
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from needle_common.errors import UserError

# Above 101 the ports reach into the range that Linux gives out to outgoing connections; 0 is where
# everything runs that was not told otherwise.
DOMAINS = range(1, 100)
# RTPS: port of the first participant's discovery in a domain.
PORT_BASE = 7400
PORTS_PER_DOMAIN = 250
FIRST_PARTICIPANT = 10


@contextmanager
def own_domain() -> Iterator[int]:
    """Reserve a ROS_DOMAIN_ID for as long as the context lasts.

    Two holders never get the same: each domain has a lock file, which the kernel frees whatever
    becomes of the holder. A domain where a foreign node listens is passed over.

    Raises
    ------
    UserError
        If all are taken.
    """
    candidates = list(DOMAINS)
    random.shuffle(candidates)
    for domain in candidates:
        lock = _lock(domain)
        if lock is None:
            continue
        try:
            if _is_silent(domain):
                yield domain
                return
        finally:
            os.close(lock)
    raise UserError("no free ROS_DOMAIN_ID on this machine: is anything left running?")


def _lock(domain: int) -> int | None:
    path = Path(tempfile.gettempdir()) / f"needle_ros_domain_{domain}.lock"
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except OSError:
        return None  # another user's
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def _is_silent(domain: int) -> bool:
    port = PORT_BASE + PORTS_PER_DOMAIN * domain + FIRST_PARTICIPANT
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", port))
        except OSError:
            return False
    return True
