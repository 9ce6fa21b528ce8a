"""Which CAN adapter, and where it is."""

from __future__ import annotations

import dataclasses

from needle_core.errors import UserError

LINKS = ("slcan", "socketcan", "socketcand", "virtual")
SLCAN_BITRATES = (
    *(10_000, 20_000, 50_000, 83_300, 100_000),
    *(125_000, 250_000, 500_000, 750_000, 1_000_000),
)
"""Bitrates that the protocol has [bit/s]."""


@dataclasses.dataclass(frozen=True)
class LinkSettings:
    """Kind of the adapter, and where it is.

    Attributes
    ----------
    kind : str
        `slcan` (serial adapter or pseudo-terminal), `socketcan` (Linux interface), `socketcand`
        (a remote one over TCP) or `virtual` (inside this process: tests).
    channel : str
        Device file or interface name.
    bitrate : int
        Of the CAN bus [bit/s]; slcan only, the others are set up outside.
    tty_baudrate : int
        Of the serial port [bit/s]; slcan only.
    host : str
        socketcand only.
    port : int
        socketcand only.
    write_timeout : float
        How long a frame may wait for room [s]; slcan and socketcand only.
    """

    kind: str
    channel: str
    bitrate: int = 500_000
    tty_baudrate: int = 115_200
    host: str = "localhost"
    port: int = 29536
    write_timeout: float = 0.05

    def __post_init__(self) -> None:
        """Refuse what names no link.

        Raises
        ------
        UserError
            A kind that does not exist, no channel, or a bitrate that slcan does not have.
        """
        if self.kind not in LINKS:
            raise UserError(f"link = {self.kind!r} is not one of {', '.join(LINKS)}")
        if not self.channel:
            raise UserError(f"channel is empty: name the {self.kind} device or interface")
        if self.kind == "slcan" and self.bitrate not in SLCAN_BITRATES:
            known = ", ".join(map(str, SLCAN_BITRATES))
            raise UserError(f"bitrate = {self.bitrate} bit/s: slcan has {known}")

    def __str__(self) -> str:
        """Return what messages call the link."""
        if self.kind == "socketcand":
            return f"socketcand {self.host}:{self.port} {self.channel}"
        return f"{self.kind} {self.channel}"
