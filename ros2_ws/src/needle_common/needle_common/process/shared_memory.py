"""Fast DDS's shared memory: kept from other users, and taken away where a process was killed.

A port is a file that every process of a domain opens. Who is killed never closes it: the count of
its users stays wrong for good, and the next run in that domain inherits the file.
"""

from __future__ import annotations

import contextlib
import fcntl
from collections.abc import Iterable
from pathlib import Path

SHARED_MEMORY = Path("/dev/shm")
_PREFIX = "fastrtps_"


def make_private() -> None:
    """Keep other users from reading the shared memory that this process has open.

    It holds every image. Fast DDS opens it to all readers, whatever the umask (mode 0644).
    """
    maps = Path("/proc/self/maps").read_text(encoding="utf-8", errors="replace")
    open_here = {
        line.split()[-1] for line in maps.splitlines() if f" {SHARED_MEMORY}/{_PREFIX}" in line
    }
    for path in open_here:
        # Another user's, or gone.
        with contextlib.suppress(OSError):
            Path(path).chmod(0o600)


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
