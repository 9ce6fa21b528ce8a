"""Access to an input device of the kernel (evdev): its events, keys and axes."""

from __future__ import annotations

import dataclasses
import errno
import fcntl
import os
import struct

_KEY_BYTES = 96  # one bit for each code up to KEY_MAX, 0x2ff
_ABSINFO = struct.Struct("@6i")  # value, minimum, maximum, fuzz, flat, resolution
_MAX_READ = 65536
# struct input_event of a 64-bit kernel: time (two longs), type, code, value.
EVENT = struct.Struct("@llHHi")
_EV_SYN, _EV_KEY = 0, 1
_SYN_DROPPED = 3
_RELEASED, _PRESSED = 0, 1


def _request(number: int, size: int) -> int:
    """Return the ioctl number that reads `size` bytes from an input device."""
    return 2 << 30 | size << 16 | ord("E") << 8 | number


# Names as in linux/input.h.
EVIOCGKEY = _request(0x18, _KEY_BYTES)
EVIOCGBIT_KEY = _request(0x20 + 1, _KEY_BYTES)


def eviocgabs(axis: int) -> int:
    """Return the ioctl number that reads an axis."""
    return _request(0x40 + axis, _ABSINFO.size)


class InputDevice:
    """Open device file; no call blocks, and every call raises an OSError if the device is gone.

    Parameters
    ----------
    path : str
        The device file.

    Raises
    ------
    OSError
        If it cannot be opened, or is not an input device.
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
        """Return the queued events, complete and as packed by the kernel.

        Raises
        ------
        OSError
            If the device is gone.
        """
        try:
            data = os.read(self._file, _MAX_READ)
        except BlockingIOError:
            return b""
        if not data:
            raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))
        return data

    def keys_down(self) -> frozenset[int]:
        """Return the codes of the keys that are down."""
        return self._bits(EVIOCGKEY)

    def axis(self, code: int) -> float:
        """Return the position of an axis, from -1 to 1; 0 for an axis without a range.

        Raises
        ------
        OSError
            If there is no such axis.
        """
        info = fcntl.ioctl(self._file, eviocgabs(code), bytes(_ABSINFO.size))
        value, low, high, *_ = _ABSINFO.unpack(info)
        return 2.0 * (value - low) / (high - low) - 1.0 if high > low else 0.0

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)

    def _bits(self, request: int) -> frozenset[int]:
        return set_bits(fcntl.ioctl(self._file, request, bytes(_KEY_BYTES)))


def set_bits(data: bytes) -> frozenset[int]:
    """Return the numbers of the set bits; the lowest bit of the first byte is 0."""
    return frozenset(
        8 * index + bit for index, byte in enumerate(data) for bit in range(8) if byte >> bit & 1
    )


@dataclasses.dataclass(frozen=True)
class KeyChanges:
    """Keys that went down or up since the last reading.

    Attributes
    ----------
    pressed, released : frozenset of int
        Codes of the keys; a key can be in both. Key repeats are in neither.
    dropped : bool
        Whether the kernel dropped events, so that the changes are incomplete.
    """

    pressed: frozenset[int] = frozenset()
    released: frozenset[int] = frozenset()
    dropped: bool = False


def key_changes(data: bytes) -> KeyChanges:
    """Return the key changes in events as packed by the kernel."""
    changed: dict[int, set[int]] = {_PRESSED: set(), _RELEASED: set()}
    dropped = False
    for _, _, kind, code, value in EVENT.iter_unpack(data):
        dropped |= kind == _EV_SYN and code == _SYN_DROPPED
        if kind == _EV_KEY and value in changed:
            changed[value].add(code)
    return KeyChanges(frozenset(changed[_PRESSED]), frozenset(changed[_RELEASED]), dropped)
