"""A device file of the kernel's input devices: what it sends, and what it is asked for."""

from __future__ import annotations

import errno
import fcntl
import os
import struct

_KEY_BYTES = 96  # one bit for each code up to KEY_MAX, 0x2ff
_ABSINFO = struct.Struct("@6i")  # value, minimum, maximum, fuzz, flat, resolution
_LONGEST_READ = 65536


def _request(number: int, size: int) -> int:
    """Return the ioctl that reads so many bytes from an input device."""
    return 2 << 30 | size << 16 | ord("E") << 8 | number


# Names of linux/input.h.
EVIOCGKEY = _request(0x18, _KEY_BYTES)
EVIOCGBIT_KEY = _request(0x20 + 1, _KEY_BYTES)


def eviocgabs(axis: int) -> int:
    """Return the ioctl that asks for an axis."""
    return _request(0x40 + axis, _ABSINFO.size)


class InputDevice:
    """An open device file, never waited for.

    Every call raises OSError where the device is gone.

    Parameters
    ----------
    path : str
        The device file.

    Raises
    ------
    OSError
        If it cannot be opened, or is no input device.
    """

    def __init__(self, path: str) -> None:
        self._file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            self.keys = self._bits(EVIOCGBIT_KEY)
        except OSError as error:
            os.close(self._file)
            if error.errno in (errno.ENOTTY, errno.EINVAL):
                raise OSError(error.errno, "no input device") from error
            raise

    def read(self) -> bytes:
        """Return the events that wait, as the kernel packs them; empty: none.

        Raises
        ------
        OSError
            If the device is gone.
        """
        try:
            data = os.read(self._file, _LONGEST_READ)
        except BlockingIOError:
            return b""
        if not data:
            raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))
        return data

    def keys_down(self) -> frozenset[int]:
        """Return the codes of the keys that are down now."""
        return self._bits(EVIOCGKEY)

    def axis(self, code: int) -> float:
        """Return where an axis is now, -1 at its least and 1 at its most; 0 where it has no range.

        Raises
        ------
        OSError
            If there is no such axis.
        """
        info = fcntl.ioctl(self._file, eviocgabs(code), bytes(_ABSINFO.size))
        value, least, most, *_ = _ABSINFO.unpack(info)
        return 2.0 * (value - least) / (most - least) - 1.0 if most > least else 0.0

    def close(self) -> None:
        """Let go of the file."""
        os.close(self._file)

    def _bits(self, request: int) -> frozenset[int]:
        return set_bits(fcntl.ioctl(self._file, request, bytes(_KEY_BYTES)))


def set_bits(data: bytes) -> frozenset[int]:
    """Return the numbers of the bits that are set, the lowest of the first byte being 0."""
    return frozenset(
        8 * index + bit for index, byte in enumerate(data) for bit in range(8) if byte >> bit & 1
    )
