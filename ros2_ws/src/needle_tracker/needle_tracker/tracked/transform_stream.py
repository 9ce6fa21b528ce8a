"""OpenIGTLink TRANSFORM messages in a stream of bytes, as PlusServer sends them."""

from __future__ import annotations

import dataclasses
import math
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from needle_core.diagnostics import sanitize

_HEADER = 58  # [bytes]
_TYPE_AT, _TRANSFORM = 2, b"TRANSFORM\0"
_VERSIONS = (1, 2, 3)
_LARGEST_BODY = 1 << 20  # larger ones, such as images, are skipped unread [bytes]


@dataclasses.dataclass(frozen=True)
class TrackerTransform:
    """A transform as received.

    Attributes
    ----------
    name : str
        Such as NeedleToTracker.
    stamp : float
        Time of the measurement [s] since 1970.
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
        # Optional dependency: the rest of this package works without it.
        import pyigtl.messages as igtl  # noqa: PLC0415

        self._rest += data
        while len(self._rest) >= _HEADER:
            header = self._rest[:_HEADER]
            try:
                fields = igtl.MessageBase.parse_header(header)
                is_header = fields["header_version"] in _VERSIONS
            except UnicodeDecodeError:
                is_header = False
            if not is_header or fields["body_size"] > _LARGEST_BODY:
                self._skip_to_transform()
                yield "unreadable header"
                continue
            end = _HEADER + fields["body_size"]
            if len(self._rest) < end:
                return
            body, self._rest = self._rest[_HEADER:end], self._rest[end:]
            if igtl.CRC64(body) != struct.unpack(">Q", header[-8:])[0]:
                yield "wrong checksum"
            elif fields["message_type"] == "TRANSFORM":
                yield _transform(igtl.TransformMessage(), fields, body)

    def _skip_to_transform(self) -> None:
        """Discard everything before the next possible header of a TRANSFORM."""
        at = self._rest.find(_TRANSFORM, _TYPE_AT + 1)
        self._rest = self._rest[at - _TYPE_AT if at >= 0 else -(_TYPE_AT + len(_TRANSFORM)) :]


def _transform(message: Any, fields: dict[str, Any], body: bytes) -> TrackerTransform | str:
    try:
        message.unpack(fields, body)
    except (struct.error, UnicodeDecodeError, TypeError):
        return f"unreadable body of {len(body)} bytes"
    stamp = message.timestamp if message.timestamp > 0.0 else math.nan
    status = message.metadata.get("TransformStatus", "")
    matrix = np.asarray(message.matrix, dtype=np.float64)
    return TrackerTransform(sanitize(message.device_name), stamp, matrix, sanitize(status))
