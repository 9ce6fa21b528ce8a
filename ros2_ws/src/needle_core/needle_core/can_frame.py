"""A CAN frame."""

from __future__ import annotations

import dataclasses

CAN = "can"
"""Name of the ports on the rig's CAN bus."""


@dataclasses.dataclass(frozen=True)
class CanFrame:
    """A classic CAN frame with an 11-bit identifier.

    Attributes
    ----------
    identifier : int
        0..0x7FF; CANopen calls it COB-ID.
    data : bytes
        0..8 bytes.
    remote : bool
        A request for the frame of that identifier; it has no data.
    """

    identifier: int
    data: bytes = b""
    remote: bool = False
