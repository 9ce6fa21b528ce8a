"""A simulated foot pedal, whose events come through a named pipe.

`python -m campaign.trials.holds.piped_pedal` runs the operator with this pedal.
"""

from __future__ import annotations

import errno
import os
import struct
import sys
from pathlib import Path

KEY = 48
# struct input_event of a 64-bit kernel.
_EVENT = struct.Struct("@llHHi")
_SYN, _KEY = 0, 1
_LONGEST_READ = 65536


class PipedPedal:
    """The pedal, initially released.

    Parameters
    ----------
    path : Path
        Path of its device file.
    """

    def __init__(self, path: Path) -> None:
        os.mkfifo(path)
        # Opened for reading too: a write-only open fails without a reader.
        self._pipe = os.open(path, os.O_RDWR | os.O_NONBLOCK)

    def press(self, down: bool) -> None:
        """Press or release it."""
        events = _EVENT.pack(0, 0, _KEY, KEY, down) + _EVENT.pack(0, 0, _SYN, 0, 0)
        os.write(self._pipe, events)

    def close(self) -> None:
        """Close the pipe."""
        os.close(self._pipe)


class PipeDevice:
    """Event device that reads the pipe of a `PipedPedal`.

    After opening, it has the present state and no earlier events, as the kernel's event devices.

    Parameters
    ----------
    path : str
        The pipe; raises OSError if it does not exist.
    """

    keys = frozenset((KEY,))

    def __init__(self, path: str) -> None:
        self._is_down = False
        self._pipe = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        self.read()

    def read(self) -> bytes:
        """Return pending events."""
        try:
            data = os.read(self._pipe, _LONGEST_READ)
        except BlockingIOError:
            return b""
        for _, _, kind, _, value in _EVENT.iter_unpack(data):
            self._is_down = bool(value) if kind == _KEY else self._is_down
        return data

    def keys_down(self) -> frozenset[int]:
        """Return the codes of the pressed keys."""
        return self.keys if self._is_down else frozenset()

    def axis(self, code: int) -> float:
        """Raise OSError, because a pedal has no axes."""
        raise OSError(errno.EINVAL, f"axis {code} of a pedal")

    def close(self) -> None:
        """Close the pipe."""
        os.close(self._pipe)


if __name__ == "__main__":
    # The trial itself uses the pedal without the operator's imports.
    from needle_bringup.ros import operator

    sys.exit(operator.main(PipeDevice))
