"""Light from the needle to a camera: it needs no network. No ROS in here."""

from __future__ import annotations

import mmap
import struct
from pathlib import Path

_PLACE = struct.Struct("dd")


class Light:
    """Position of the needle, for processes of one machine whatever their networks.

    Parameters
    ----------
    path : Path
        A file; made where it is not there.
    """

    def __init__(self, path: Path) -> None:
        if not path.exists():
            path.write_bytes(bytes(_PLACE.size))
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), _PLACE.size)

    @property
    def joints(self) -> tuple[float, float]:
        """Insertion [m] and rotation [rad]."""
        insertion, rotation = _PLACE.unpack(self._memory[:])
        return insertion, rotation

    @joints.setter
    def joints(self, place: tuple[float, float]) -> None:
        self._memory[:] = _PLACE.pack(*place)

    def close(self) -> None:
        """Look away."""
        self._memory.close()
