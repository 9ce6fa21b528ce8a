"""OpenIGTLink messages from clients: the points that a planner such as 3D Slicer sends."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Iterator

from needle_core.messages import Vector3

MAX_BODY = 65536
"""Longest body of a message [byte]; one of points has 136 a point."""
_HEADER = struct.Struct("> H 12s 20s 8x Q 8x")
_EXTENDED_HEADER = struct.Struct("> H H I 4x")
_POINT = struct.Struct("> 64s 36x 3f 24x")


@dataclasses.dataclass(frozen=True)
class ClientMessage:
    """A message: version of its header, type, device name and body."""

    version: int
    kind: str
    name: str
    body: bytes

    def points(self) -> list[tuple[str, Vector3]]:
        """Return names and positions [m] of the points of a POINT message.

        Raises
        ------
        struct.error
            If the body is not a list of points.
        """
        body = self.body
        if self.version > 1:
            extended, metadata_header, metadata = _EXTENDED_HEADER.unpack_from(body)
            body = body[extended : len(body) - metadata_header - metadata]
        return [
            (_text(name), (1e-3 * x, 1e-3 * y, 1e-3 * z))
            for name, x, y, z in _POINT.iter_unpack(body)
        ]


class MessageStream:
    """Splits the bytes of one client into messages.

    Attributes
    ----------
    problem : str
        Why the bytes are no messages; they are ignored from there on. Empty: they are.
    """

    def __init__(self) -> None:
        self.problem = ""
        self._received = b""

    def split(self, data: bytes) -> Iterator[ClientMessage]:
        """Yield the messages that are complete with `data`."""
        self._received = b"" if self.problem else self._received + data
        while len(self._received) >= _HEADER.size:
            version, kind, name, size = _HEADER.unpack_from(self._received)
            if version not in (1, 2, 3) or size > MAX_BODY:
                self.problem, self._received = f"header version {version}, {size} bytes", b""
                return
            end = _HEADER.size + size
            if len(self._received) < end:
                return
            body, self._received = self._received[_HEADER.size : end], self._received[end:]
            yield ClientMessage(version, _text(kind), _text(name), body)


def _text(field: bytes) -> str:
    return field.partition(b"\0")[0].decode("utf-8", "replace").strip()
