"""Fast DDS's shared memory, taken away where a process was killed.

A port is a file that every process of a domain opens. Who is killed never closes it: the count of
its users stays wrong for good, and the next run in that domain inherits the file. Who is killed
while making one leaves a file for which whoever opens it waits for ever, as every node of this
machine does for that of port 7000. Without this module one of 36 restarts after `kill -9` heard
nothing any more.
"""

from __future__ import annotations

import contextlib
import fcntl
import re
import sys
import time
from collections.abc import Iterable
from pathlib import Path

SHARED_MEMORY = Path("/dev/shm")
_PREFIX = "fastrtps_"
_PORT = re.compile(rf"{_PREFIX}port\d+")
# Boost's first word of a segment: not begun, under way. What is made is neither.
_HALF_MADE = (0, 1)
# Making one takes less than a millisecond; on a busy machine its maker may have to wait [s].
_MAKING = 1.0


def dead_ports(ports: Iterable[int], folder: Path = SHARED_MEMORY) -> list[str]:
    """Return the names of the shared-memory ports on which no living process listens.

    Parameters
    ----------
    ports : iterable of int
        Port numbers to look for.
    folder : Path
        Where shared memory is mounted.
    """
    return [
        name
        for name in map(_name, ports)
        if any(path.exists() for path in _files(folder, name)) and not _is_held(folder, name)
    ]


def remove_dead_ports(ports: Iterable[int], folder: Path = SHARED_MEMORY) -> None:
    """Remove the ports on which no living process listens; another user's stay.

    Parameters
    ----------
    ports : iterable of int
        Port numbers of a domain that has ended, or not begun.
    folder : Path
        Where shared memory is mounted.
    """
    for name in dead_ports(ports, folder):
        for path in _files(folder, name):
            with contextlib.suppress(OSError):
                path.unlink()


def remove_incomplete_ports(folder: Path = SHARED_MEMORY) -> None:
    """Remove the ports that were half made when their maker ended; what is being made is awaited.

    Parameters
    ----------
    folder : Path
        Where shared memory is mounted.
    """
    found = _half_made_ports(folder)
    if not found:
        return
    time.sleep(_MAKING)
    for path, inode in _half_made_ports(folder).items():
        if found.get(path) == inode:
            with contextlib.suppress(OSError):
                path.unlink()


def _half_made_ports(folder: Path) -> dict[Path, int]:
    """Return the inodes of half-made ports on which nobody listens."""
    found = {}
    for path in folder.glob(f"{_PREFIX}port*"):
        # Another user's, or gone.
        with contextlib.suppress(OSError):
            if _PORT.fullmatch(path.name) and _is_half_made(path):
                found[path] = path.stat().st_ino
    return found


def _is_half_made(port: Path) -> bool:
    with port.open("rb") as file:
        state = file.read(4)
    unwritten = len(state) < 4 or int.from_bytes(state, sys.byteorder) in _HALF_MADE
    return unwritten and not _is_held(port.parent, port.name)


def _files(folder: Path, name: str) -> tuple[Path, Path, Path]:
    return folder / name, folder / f"{name}_el", folder / f"sem.{name}_mutex"


def _name(port: int) -> str:
    return f"{_PREFIX}port{port}"


def _is_held(folder: Path, name: str) -> bool:
    """Return whether a process listens: it holds this lock until it ends, however it ends."""
    _, lock, _ = _files(folder, name)
    try:
        with lock.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False
