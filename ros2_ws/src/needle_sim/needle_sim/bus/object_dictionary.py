"""Object dictionary of a CANopen device (CiA 301) and the SDO server that gives access to it."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable
from typing import Any


class Abort(enum.IntEnum):
    """SDO abort codes of CiA 301."""

    TOGGLE = 0x05030000
    COMMAND = 0x05040001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    MAPPING_TOO_LONG = 0x06040042
    WRONG_LENGTH = 0x06070010
    NO_SUBINDEX = 0x06090011
    VALUE_RANGE = 0x06090030
    DEVICE_STATE = 0x08000022


class SdoAbortError(Exception):
    """SDO access that the device rejects."""

    def __init__(self, code: Abort) -> None:
        super().__init__(f"{code.name} (0x{code:08X})")
        self.code = code


def one_of(values: tuple[int, ...]) -> Callable[[int], None]:
    """Return a check that rejects any value not in `values`."""

    def check(value: int) -> None:
        if value not in values:
            raise SdoAbortError(Abort.VALUE_RANGE)

    return check


class Kind(enum.Enum):
    """Numeric type.

    Attributes
    ----------
    size : int
        Size in bytes.
    signed : bool
        Whether it is signed.
    bounds : tuple of int
        Smallest and largest value.
    """

    U8 = (1, False)
    U16 = (2, False)
    U32 = (4, False)
    I8 = (1, True)
    I16 = (2, True)
    I32 = (4, True)

    def __init__(self, size: int, signed: bool) -> None:
        self.size, self.signed = size, signed
        bits = 8 * size
        self.bounds = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)


@dataclasses.dataclass
class StoredObject:
    """Value in the dictionary.

    Attributes
    ----------
    kind : Kind or None
        Type of the number; None for a text.
    value, default : int
        The number, now and after power-up; 0 for a text.
    writable : bool
        Whether a client may write it.
    mappable : bool
        Whether a PDO may contain it.
    text : bytes
        The text; empty for a number.
    check : callable, optional
        Called before a client's value is stored; raises `SdoAbortError` to reject it.
    on_written : callable, optional
        Called with the value after it is stored.
    """

    kind: Kind | None
    value: int
    default: int
    writable: bool = False
    mappable: bool = False
    text: bytes = b""
    check: Callable[[int], None] | None = None
    on_written: Callable[[int], None] | None = None


class ObjectDictionary:
    """Values by index and sub-index, with access rights and callbacks for writing."""

    def __init__(self) -> None:
        self._entries: dict[tuple[int, int], StoredObject] = {}

    def add(
        self, index: int, subindex: int, kind: Kind | None, value: int = 0, **attributes: Any
    ) -> None:
        """Add an entry with the attributes of `StoredObject`."""
        self._entries[index, subindex] = StoredObject(kind, value, value, **attributes)

    def entry(self, index: int, subindex: int = 0) -> StoredObject:
        """Return an entry.

        Raises
        ------
        SdoAbortError
            If the entry does not exist.
        """
        entry = self._entries.get((index, subindex))
        if entry is None:
            known = any(index == key[0] for key in self._entries)
            raise SdoAbortError(Abort.NO_SUBINDEX if known else Abort.NO_OBJECT)
        return entry

    def value(self, index: int, subindex: int = 0) -> int:
        """Return a number."""
        return self._entries[index, subindex].value

    def set(self, index: int, subindex: int, value: int) -> None:
        """Set a number from inside the device: without checks, but clipped to its type."""
        entry = self._entries[index, subindex]
        assert entry.kind is not None
        lower, upper = entry.kind.bounds
        entry.value = value if lower <= value <= upper else min(max(value, lower), upper)

    def read(self, index: int, subindex: int) -> bytes:
        """Return a value as bytes, little-endian.

        Raises
        ------
        SdoAbortError
            If the entry does not exist.
        """
        entry = self.entry(index, subindex)
        if entry.kind is None:
            return entry.text
        return entry.value.to_bytes(entry.kind.size, "little", signed=entry.kind.signed)

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Write a value for a client.

        Raises
        ------
        SdoAbortError
            If the device rejects it; the value stays unchanged.
        """
        entry = self.entry(index, subindex)
        if not entry.writable or entry.kind is None:
            raise SdoAbortError(Abort.READ_ONLY)
        if len(data) != entry.kind.size:
            raise SdoAbortError(Abort.WRONG_LENGTH)
        value = int.from_bytes(data, "little", signed=entry.kind.signed)
        if entry.check is not None:
            entry.check(value)
        entry.value = value
        if entry.on_written is not None:
            entry.on_written(value)

    def power_up(self) -> None:
        """Reset all values to their defaults."""
        for entry in self._entries.values():
            entry.value = entry.default


# Command specifiers of the client, in the upper three bits of the first byte.
_DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = range(1, 5)
_TOGGLE = 0x10
_SEGMENT = 7
_EXPEDITED = 4


class SdoServer:
    """SDO server for one client: expedited downloads, expedited and segmented uploads, no blocks.

    Parameters
    ----------
    dictionary : ObjectDictionary
        Object dictionary of the device.
    """

    def __init__(self, dictionary: ObjectDictionary) -> None:
        self._dictionary = dictionary
        self._multiplexer = bytes(3)
        # Data of an upload that are not sent yet.
        self._rest = b""
        self._toggle = 0

    def answer(self, request: bytes) -> bytes | None:
        """Return the answer to a request, or None if it needs none or is not 8 bytes long."""
        if len(request) != 8:
            return None
        if request[0] >> 5 != _UPLOAD_SEGMENT:
            self._rest = b""
        if request[0] >> 5 == _ABORT:
            return None
        try:
            return self._execute(request)
        except SdoAbortError as error:
            self._rest = b""
            return b"\x80" + self._multiplexer + int(error.code).to_bytes(4, "little")

    def _execute(self, request: bytes) -> bytes:
        command, specifier = request[0], request[0] >> 5
        if specifier == _UPLOAD_SEGMENT and self._rest:
            return self._next_segment(command)
        if specifier in (_DOWNLOAD, _UPLOAD):
            self._multiplexer = request[1:4]
            key = int.from_bytes(request[1:3], "little"), request[3]
            if specifier == _UPLOAD:
                return self._begin_upload(self._dictionary.read(*key))
            # Writable objects have at most 4 bytes and need no segments.
            if command & 2:
                unused = command >> 2 & 3 if command & 1 else 0
                self._dictionary.write(*key, request[4 : 8 - unused])
                return b"\x60" + self._multiplexer + bytes(4)
        raise SdoAbortError(Abort.COMMAND)

    def _begin_upload(self, data: bytes) -> bytes:
        if len(data) <= _EXPEDITED:
            command = 0x43 | (_EXPEDITED - len(data)) << 2
            return bytes([command]) + self._multiplexer + data.ljust(4, b"\0")
        self._rest, self._toggle = data, 0
        return b"\x41" + self._multiplexer + len(data).to_bytes(4, "little")

    def _next_segment(self, command: int) -> bytes:
        if command & _TOGGLE != self._toggle:
            raise SdoAbortError(Abort.TOGGLE)
        part, self._rest = self._rest[:_SEGMENT], self._rest[_SEGMENT:]
        answer = self._toggle | (_SEGMENT - len(part)) << 1 | (not self._rest)
        self._toggle ^= _TOGGLE
        return bytes([answer]) + part.ljust(_SEGMENT, b"\0")
