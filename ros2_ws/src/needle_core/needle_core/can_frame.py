"""CAN frames and errors, as they pass through the port `can`."""

from __future__ import annotations

import dataclasses

CAN = "can"
"""Name of the ports on the rig's CAN bus."""


@dataclasses.dataclass(frozen=True)
class CanFrame:
    """Classic CAN frame with an 11-bit identifier.

    Attributes
    ----------
    identifier : int
        0..0x7FF; the COB-ID of CANopen.
    data : bytes
        0..8 bytes.
    remote : bool
        Whether this is a remote request for the frame with this identifier; it carries no data.
    time : float or None
        Monotonic arrival time [s]; None if the port does not measure it.
    """

    identifier: int
    data: bytes = b""
    remote: bool = False
    time: float | None = None


@dataclasses.dataclass(frozen=True)
class CanErrors:
    """Errors of a port since the last batch.

    Attributes
    ----------
    frames : int
        Number of error frames and malformed lines.
    refusals : int
        Number of commands and frames that the adapter rejected.
    """

    frames: int
    refusals: int = 0
