"""Settings of the CAN adapter, as parameters of a node."""

from __future__ import annotations

import dataclasses

from needle_core.errors import UserError
from needle_core.settings.parameter_fields import check_fields, fixed_parameter

SLCAN_BITRATES = (
    *(10_000, 20_000, 50_000, 83_300, 100_000),
    *(125_000, 250_000, 500_000, 750_000, 1_000_000),
)
"""Bitrates that the slcan protocol supports [bit/s]."""


@dataclasses.dataclass(frozen=True)
class LinkSettings:
    """Settings of the CAN adapter."""

    link: str = fixed_parameter(
        "slcan",
        "-",
        "slcan: serial adapter or pseudo-terminal; socketcan: Linux CAN interface; socketcand: CAN "
        "interface over TCP; virtual: inside one process.",
        choices=("slcan", "socketcan", "socketcand", "virtual"),
    )
    channel: str = fixed_parameter(
        "/dev/ttyACM0", "-", "Device file (slcan) or name of the CAN interface."
    )
    bitrate: int = fixed_parameter(
        500_000, "bit/s", "Bitrate of the CAN bus; slcan only.", 10_000, 1_000_000
    )
    tty_baudrate: int = fixed_parameter(
        115_200, "bit/s", "Of the serial port; slcan only, USB adapters ignore it.", 9600, 4_000_000
    )
    host: str = fixed_parameter("localhost", "-", "Host of the socketcand server.")
    port: int = fixed_parameter(29536, "-", "Port of the socketcand server.", 1, 65535)

    def __post_init__(self) -> None:
        """Check the settings.

        Raises
        ------
        UserError
            A value out of bounds, an empty channel, or a bitrate that slcan does not support.
        """
        check_fields(self)
        if not self.channel:
            raise UserError(f"channel is empty: name the {self.link} device or interface")
        if self.link == "slcan" and self.bitrate not in SLCAN_BITRATES:
            known = ", ".join(map(str, SLCAN_BITRATES))
            raise UserError(f"bitrate = {self.bitrate} bit/s: slcan has {known}")

    @property
    def link_name(self) -> str:
        """Name of the link in messages."""
        at = f"{self.host}:{self.port} " if self.link == "socketcand" else ""
        return f"{self.link} {at}{self.channel}"
