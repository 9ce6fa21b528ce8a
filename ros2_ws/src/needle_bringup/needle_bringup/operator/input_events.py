"""Events of the kernel's input devices (evdev), from the bytes that a device file gives."""

from __future__ import annotations

import dataclasses
import struct

# struct input_event of a 64-bit kernel: a time of two longs, type, code, value.
EVENT = struct.Struct("@llHHi")

_EV_SYN, _EV_KEY = 0, 1
_SYN_DROPPED = 3
_RELEASED, _PRESSED = 0, 1


@dataclasses.dataclass(frozen=True)
class KeyChanges:
    """Which keys went down and came up since the last look.

    Attributes
    ----------
    pressed, released : frozenset of int
        Their codes; a key that did both is in both. Key repeat is neither.
    dropped : bool
        Whether the kernel threw events away, so that any key may have done anything.
    """

    pressed: frozenset[int] = frozenset()
    released: frozenset[int] = frozenset()
    dropped: bool = False


class EventReader:
    """Makes changes of keys of a device's bytes, which may be cut anywhere."""

    def __init__(self) -> None:
        self._rest = b""

    def take(self, data: bytes) -> KeyChanges:
        """Return what the bytes that follow those before tell."""
        data = self._rest + data
        whole = len(data) - len(data) % EVENT.size
        self._rest = data[whole:]
        changed: dict[int, set[int]] = {_PRESSED: set(), _RELEASED: set()}
        dropped = False
        for _, _, kind, code, value in EVENT.iter_unpack(data[:whole]):
            dropped |= kind == _EV_SYN and code == _SYN_DROPPED
            if kind == _EV_KEY and value in changed:
                changed[value].add(code)
        return KeyChanges(frozenset(changed[_PRESSED]), frozenset(changed[_RELEASED]), dropped)
