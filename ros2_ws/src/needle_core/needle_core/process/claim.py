"""A name that one process of this machine has at a time.

Discovery takes up to seconds, and two that start at once do not know each other yet. A name in the
kernel is taken at once, by one only, and is free again in the moment in which its process ends,
however it ends.
"""

from __future__ import annotations

import hashlib
import os
import socket
import weakref
from pathlib import Path

from needle_core.errors import UserError

# What to do about two that may not be in one graph.
WAY_OUT = "end one of the two, or give one a ROS_DOMAIN_ID of its own"
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
