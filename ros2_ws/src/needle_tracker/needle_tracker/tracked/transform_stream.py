"""OpenIGTLink TRANSFORM messages in a stream of bytes, as PlusServer sends them."""

from __future__ import annotations

import dataclasses
import functools
import struct
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from needle_core.diagnostics import sanitize

# Version, type, name, seconds and fraction of the stamp, size and checksum of the body.
_HEADER = struct.Struct(">H12s20sIIQQ")
# Size of the extended header, of the keys' index and of keys and values; number of the message.
_EXTENDED, _PAIR = struct.Struct(">HHII"), struct.Struct(">HHI")
_MATRIX = struct.Struct(">12f")
_TRANSFORM = b"TRANSFORM".ljust(12, b"\0")
_LARGEST_BODY = 1 << 20  # larger ones, such as images, are skipped unread [bytes]
_MASK, _POLYNOMIAL = (1 << 64) - 1, 0x42F0E1EBA9EA3693


@dataclasses.dataclass(frozen=True)
class TrackerTransform:
    """A transform as received.

    Attributes
    ----------
    name : str
        Such as NeedleToTracker.
    stamp : float
        Time of the measurement [s] since 1970; 0 if there is none.
    matrix : ndarray, shape (4, 4)
        Pose of the sensor in the tracker's frame; translation in the sender's unit.
    status : str
        The tracker's own assessment: OK, MISSING, OUT_OF_VOLUME; empty if it sends none.
    """

    name: str
    stamp: float
    matrix: NDArray[np.float64]
    status: str = ""


class TransformStream:
    """Splits a stream into messages; skips other messages, and unreadable ones by name."""

    def __init__(self) -> None:
        self._rest = b""

    def clear(self) -> None:
        """Discard an incomplete message."""
        self._rest = b""

    def receive(self, data: bytes) -> Iterator[TrackerTransform | str]:
        """Yield the transforms that these bytes complete, and the reasons to skip others."""
        self._rest += data
        while len(self._rest) >= _HEADER.size:
            version, kind, name, seconds, fraction, size, crc = _HEADER.unpack_from(self._rest)
            if version not in (1, 2, 3) or size > _LARGEST_BODY:
                self._skip_to_transform()
                yield "unreadable header"
                continue
            end = _HEADER.size + size
            if len(self._rest) < end:
                return
            body, self._rest = self._rest[_HEADER.size : end], self._rest[end:]
            if kind != _TRANSFORM:
                continue
            if checksum(body) != crc:
                yield "wrong checksum"
                continue
            try:
                matrix, status = _unpack(body, version)
            except (struct.error, UnicodeDecodeError):
                yield f"unreadable body of {size} bytes"
                continue
            text = sanitize(name.rstrip(b"\0").decode("ascii", "replace"))
            yield TrackerTransform(text, seconds + fraction / 2**32, matrix, sanitize(status))

    def _skip_to_transform(self) -> None:
        """Discard everything before the type of the next TRANSFORM, less its version."""
        at = self._rest.find(_TRANSFORM, 3)
        self._rest = self._rest[at - 2 if at >= 0 else -len(_TRANSFORM) - 1 :]


def _unpack(body: bytes, version: int) -> tuple[NDArray[np.float64], str]:
    """Return the matrix of a body, and PLUS's TransformStatus in its metadata."""
    start, status = 0, ""
    if version > 1:
        start, index, values, _ = _EXTENDED.unpack_from(body)
        at, place = len(body) - index - values, len(body) - values
        for pair in range(struct.unpack_from(">H", body, at)[0]):
            key, _, value = _PAIR.unpack_from(body, at + 2 + pair * _PAIR.size)
            if body[place : place + key] == b"TransformStatus":
                status = body[place + key : place + key + value].decode()
            place += key + value
    matrix = np.eye(4)
    matrix[:3] = np.reshape(_MATRIX.unpack_from(body, start), (4, 3)).T
    return matrix, status


@functools.cache
def _checksum_of(byte: int) -> int:
    value = byte << 56
    for _ in range(8):
        value = (value << 1 & _MASK) ^ (_POLYNOMIAL if value >> 63 else 0)
    return value


def checksum(data: bytes) -> int:
    """Return the CRC-64 of ECMA-182."""
    value = 0
    for byte in data:
        value = (value << 8 & _MASK) ^ _checksum_of(value >> 56 ^ byte)
    return value
