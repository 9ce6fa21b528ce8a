"""OpenIGTLink messages in a stream of bytes: transforms of a tracker, points of a planner."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from needle_core.diagnostics import sanitize
from needle_core.errors import UserError
from needle_core.messages import Vector3

# Version, type, name, seconds and fraction of the stamp, size and checksum of the body.
_HEADER = struct.Struct(">H12s20sIIQQ")
# Sizes of the extended header, of the metadata's index and of all metadata; one key and value.
_EXTENDED, _PAIR = struct.Struct(">HHI4x"), struct.Struct(">H2xI")
_MATRIX, _POINT = struct.Struct(">12f"), struct.Struct(">64s36x3f24x")
_LARGEST_BODY = 1 << 20  # [bytes]
_MASK, _POLYNOMIAL = (1 << 64) - 1, 0x42F0E1EBA9EA3693


class LinkMessage(NamedTuple):
    """Message with header version, type, device name, stamp [s] since 1970 (0: none) and body."""

    version: int
    kind: str
    name: str
    stamp: float
    body: bytes
    crc: int = 0

    def points(self) -> list[tuple[str, Vector3]]:
        """Return names and positions [m] of the points of a POINT message.

        Raises
        ------
        UserError
            If the body is not a list of points.
        """
        points, _ = self._unpack(_POINT)
        return [(_text(name), (1e-3 * x, 1e-3 * y, 1e-3 * z)) for name, x, y, z in points]

    def transform(self) -> tuple[NDArray[np.float64], str]:
        """Return the matrix of a TRANSFORM message, and PLUS's status.

        Returns
        -------
        matrix : ndarray, shape (4, 4)
            Pose of the sensor in the tracker's frame; translation in the sender's unit.
        status : str
            The tracker's own assessment: OK, MISSING, OUT_OF_VOLUME; empty if it sends none.

        Raises
        ------
        UserError
            If the checksum is wrong, or the body is not a matrix.
        """
        if checksum(self.body) != self.crc:
            raise UserError("wrong checksum")
        matrices, metadata = self._unpack(_MATRIX)
        if len(matrices) != 1:
            raise UserError(f"{len(matrices)} matrices, expected 1")
        matrix = np.eye(4)
        matrix[:3] = np.reshape(matrices[0], (4, 3)).T
        return matrix, metadata.get("TransformStatus", "")

    def _unpack(self, item: struct.Struct) -> tuple[list[tuple[Any, ...]], dict[str, str]]:
        """Return the items and the metadata of the body."""
        body, start, end, metadata = self.body, 0, len(self.body), {}
        try:
            if self.version > 1:
                start, index, values = _EXTENDED.unpack_from(body)
                end, place = len(body) - index - values, len(body) - values
                for pair in range(struct.unpack_from(">H", body, end)[0] if index else 0):
                    key, value = _PAIR.unpack_from(body, end + 2 + pair * _PAIR.size)
                    name, place = _text(body[place : place + key]), place + key
                    metadata[name], place = _text(body[place : place + value]), place + value
            return list(item.iter_unpack(body[start:end])), metadata
        except struct.error as error:
            raise UserError(f"unreadable body of {len(body)} bytes") from error


class LinkStream:
    """Splits the bytes of one sender into messages.

    Parameters
    ----------
    restart : str
        After an unreadable header, the stream continues at the next message of this type. If
        empty, it ignores all further bytes.

    Attributes
    ----------
    problem : str
        The last unreadable header of the bytes last received; empty if there was none.
    """

    def __init__(self, restart: str = "") -> None:
        self.problem, self._rest = "", b""
        self._restart = restart.encode().ljust(12, b"\0") if restart else b""

    def split(self, data: bytes) -> Iterator[LinkMessage]:
        """Yield the messages that `data` completes."""
        if self.problem and not self._restart:
            return
        self.problem, self._rest = "", self._rest + data
        while len(self._rest) >= _HEADER.size:
            version, kind, name, seconds, fraction, size, crc = _HEADER.unpack_from(self._rest)
            end = _HEADER.size + size
            if version not in (1, 2, 3) or size > _LARGEST_BODY:
                self.problem = f"unreadable header: version {version}, {size} bytes"
                if not self._restart:
                    return
                # The version is before the type.
                at = self._rest.find(self._restart, 3)
                self._rest = self._rest[at - 2 if at >= 0 else -len(self._restart) - 1 :]
            elif len(self._rest) < end:
                return
            else:
                body, self._rest = self._rest[_HEADER.size : end], self._rest[end:]
                stamp = seconds + fraction / 2**32
                yield LinkMessage(version, _text(kind), _text(name), stamp, body, crc)


def _text(field: bytes) -> str:
    return sanitize(field.partition(b"\0")[0].decode("utf-8", "replace").strip())


def checksum(data: bytes) -> int:
    """Return the CRC-64 of ECMA-182."""
    value = 0
    for byte in data:
        value ^= byte << 56
        for _ in range(8):
            value = (value << 1 & _MASK) ^ (_POLYNOMIAL if value >> 63 else 0)
    return value
