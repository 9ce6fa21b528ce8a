"""Room left on a bag's disk, and the end of a recording for want of it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

# A small disk is not given up because of a reserve that is meant for large ones.
LARGEST_SHARE: Final = 0.1


class FreeSpace:
    """The free space of the disk that holds a directory.

    Parameters
    ----------
    directory : Path
        An existing directory.
    reserve : int
        Bytes to leave free; at most `LARGEST_SHARE` of the disk is kept.

    Attributes
    ----------
    reserve : int
        Bytes that are kept free.
    """

    def __init__(self, directory: Path, reserve: int) -> None:
        self._directory = directory
        status = os.statvfs(directory)
        self.reserve = min(reserve, int(LARGEST_SHARE * status.f_blocks * status.f_frsize))

    def usable(self) -> int:
        """Return how many bytes may still be written; negative below the reserve."""
        status = os.statvfs(self._directory)
        return int(status.f_bavail * status.f_frsize) - self.reserve


def megabytes(count: float) -> str:
    """Return a number of bytes as a person reads it."""
    return f"{count / 1e6:.0f} MB" if count < 10e9 else f"{count / 1e9:.0f} GB"
