"""Clean-up of Fast DDS's shared memory after a process was killed.

A port is a file that every process of a domain opens. A killed process never closes it: its user
count stays wrong, and the next run in that domain inherits the file. A process that is killed while
it creates a port leaves an incomplete file, and every process that opens it waits forever (all
nodes of a machine open port 7000). Without this module, one of 36 restarts after `kill -9` received
no messages.
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
# First word of a Boost segment that is uninitialized or being initialized.
_INCOMPLETE = (0, 1)
# Creation takes less than a millisecond, but the process may have to wait for the CPU [s].
_CREATION_TIME = 1.0


def remove_dead_ports(ports: Iterable[int], folder: Path = SHARED_MEMORY) -> None:
    """Remove the ports on which no running process listens, except those of other users.

    Parameters
    ----------
    ports : iterable of int
        Port numbers of a domain that is not in use.
    folder : Path
        Where shared memory is mounted.
    """
    for name in (f"{_PREFIX}port{port}" for port in ports):
        for path in () if _is_held(folder, name) else _files(folder, name):
            with contextlib.suppress(OSError):
                path.unlink()


def remove_incomplete_ports(folder: Path = SHARED_MEMORY) -> None:
    """Remove incomplete ports of killed processes; wait first for ports under construction.

    Parameters
    ----------
    folder : Path
        Where shared memory is mounted.
    """
    found = _incomplete_ports(folder)
    if not found:
        return
    time.sleep(_CREATION_TIME)
    for path, inode in _incomplete_ports(folder).items():
        if found.get(path) == inode:
            with contextlib.suppress(OSError):
                path.unlink()


def _incomplete_ports(folder: Path) -> dict[Path, int]:
    """Return the inodes of incomplete ports on which no process listens."""
    found = {}
    for path in folder.glob(f"{_PREFIX}port*"):
        # The port may belong to another user, or be gone.
        with contextlib.suppress(OSError):
            if _PORT.fullmatch(path.name) and _is_incomplete(path):
                found[path] = path.stat().st_ino
    return found


def _is_incomplete(port: Path) -> bool:
    with port.open("rb") as file:
        state = file.read(4)
    unwritten = len(state) < 4 or int.from_bytes(state, sys.byteorder) in _INCOMPLETE
    return unwritten and not _is_held(port.parent, port.name)


def _files(folder: Path, name: str) -> tuple[Path, Path, Path]:
    return folder / name, folder / f"{name}_el", folder / f"sem.{name}_mutex"


def _is_held(folder: Path, name: str) -> bool:
    """Return whether a process listens; the kernel frees its lock when it ends."""
    _, lock, _ = _files(folder, name)
    try:
        with lock.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False
