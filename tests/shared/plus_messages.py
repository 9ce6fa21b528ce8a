"""OpenIGTLink messages as PlusServer packs them, byte by byte from the protocol."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from needle_core.openigtlink import checksum

_ASCII = 3


def message(kind: str, name: str, stamp: float, body: bytes, version: int = 1) -> bytes:
    """Return a message with a header."""
    seconds = int(stamp)
    fraction = int((stamp - seconds) * 2**32)
    head = struct.pack(">H12s20sII", version, kind.encode(), name.encode(), seconds, fraction)
    return head + struct.pack(">QQ", len(body), checksum(body)) + body


def transform_message(
    matrix: NDArray[np.float64], stamp: float, name: str = "NeedleToTracker", status: str = ""
) -> bytes:
    """Return a TRANSFORM in mm; with a status, header version 2 with PLUS's metadata."""
    body = struct.pack(">12f", *matrix[:3].T.ravel())
    if not status:
        return message("TRANSFORM", name, stamp, body)
    valid = "True" if status == "OK" else "False"
    pairs = [(b"TransformValid", valid.encode()), (b"TransformStatus", status.encode())]
    index = struct.pack(">H", len(pairs))
    index += b"".join(struct.pack(">HHI", len(k), _ASCII, len(v)) for k, v in pairs)
    values = b"".join(k + v for k, v in pairs)
    extended = struct.pack(">HHII", 12, len(index), len(values), 0)
    return message("TRANSFORM", name, stamp, extended + body + index + values, version=2)
