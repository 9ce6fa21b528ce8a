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
    time : float or None
        Steady time of its arrival, where its port knows it [s].
    """

    identifier: int
    data: bytes = b""
    remote: bool = False
    time: float | None = None


@dataclasses.dataclass(frozen=True)
class CanErrors:
    """Count of what a port could not hand on since the last batch.

    Attributes
    ----------
    frames : int
        Error frames, and lines that are none.
    refusals : int
        Commands and frames that the adapter did not take.
    """

    frames: int
    refusals: int = 0
