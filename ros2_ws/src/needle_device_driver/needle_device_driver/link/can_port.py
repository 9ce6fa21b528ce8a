"""Port on a CAN bus, and its settings."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import can

from needle_core.can_frame import CanErrors, CanFrame
from needle_core.errors import UserError
from needle_core.ports.reopening_port import ReopeningPort
from needle_core.settings.parameter_fields import check_fields, fixed_parameter
from needle_device_driver.link.text_bus import SLCAN_BITRATES, SlcanBus, SocketcandBus, TextBus


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
            If a value is out of bounds, the channel is empty, or slcan lacks the bitrate.
        """
        check_fields(self)
        if not self.channel:
            raise UserError(f"channel is empty: name the {self.link} device or interface")
        if self.link == "slcan" and self.bitrate not in SLCAN_BITRATES:
            known = ", ".join(map(str, sorted(SLCAN_BITRATES)))
            raise UserError(f"bitrate = {self.bitrate} bit/s: slcan has {known}")

    @property
    def link_name(self) -> str:
        """Name of the link in messages."""
        at = f"{self.host}:{self.port} " if self.link == "socketcand" else ""
        return f"{self.link} {at}{self.channel}"


_RECEIVE_TIMEOUT = 0.05
# A silent adapter may have restarted with its channel closed; after this time it is set up again.
_SILENCE = 0.4
_MAX_BATCH = 50

Batch = tuple[CanFrame | CanErrors, ...]
Bus = can.BusABC | TextBus


def open_bus(settings: LinkSettings, write_timeout: float) -> Bus:
    """Open the adapter; raises the errors of python-can and of the operating system."""
    if settings.link == "slcan":
        return SlcanBus(
            settings.channel,
            bitrate=settings.bitrate,
            tty_baudrate=settings.tty_baudrate,
            write_timeout=write_timeout,
        )
    if settings.link == "socketcand":
        return SocketcandBus(
            settings.channel,
            host=settings.host,
            port=settings.port,
            write_timeout=write_timeout,
        )
    return can.Bus(interface=settings.link, channel=settings.channel)


class CanPort(ReopeningPort[Bus]):
    """Port on a CAN bus.

    Parameters
    ----------
    settings : LinkSettings
        Settings of the adapter.
    write_timeout : float
        An adapter that accepts no frame for this time counts as lost [s].
    clock : callable
        Returns the steady time [s].
    """

    def __init__(
        self,
        settings: LinkSettings,
        write_timeout: float = 0.05,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__((can.CanError, OSError, ValueError))
        self._settings = settings
        self._write_timeout = write_timeout
        self._clock = clock
        self._received_at = 0.0
        self._errors = self._refusals = 0

    def _open_device(self) -> Bus:
        bus = open_bus(self._settings, self._write_timeout)
        self._errors = self._refusals = 0
        self._received_at = self._clock()
        return bus

    def _write(self, device: Bus, batch: tuple[CanFrame, ...]) -> None:
        for frame in batch:
            device.send(
                can.Message(arbitration_id=frame.identifier, data=frame.data, is_extended_id=False)
            )

    def _close_device(self, device: Bus) -> None:
        device.shutdown()

    def _read(self, device: Bus) -> Batch:
        batch = self._receive(device)
        if batch:
            self._received_at = self._clock()
        elif self._clock() - self._received_at > _SILENCE and isinstance(device, SlcanBus):
            self._received_at = self._clock()
            with self._lock:
                device.set_up_channel()
        return batch

    def _receive(self, bus: Bus) -> Batch:
        items: list[CanFrame | CanErrors] = []
        message, error_frames = bus.recv(_RECEIVE_TIMEOUT), 0
        while message is not None:
            if message.is_error_frame:
                error_frames += 1
            elif not (message.is_remote_frame or message.is_extended_id):
                frame = CanFrame(message.arbitration_id, bytes(message.data), time=self._clock())
                items.append(frame)
            message = bus.recv(0.0) if len(items) < _MAX_BATCH else None
        # python-can's own buses have no such counters.
        errors, refusals = getattr(bus, "malformed", 0), getattr(bus, "refused", 0)
        if error_frames or (errors, refusals) != (self._errors, self._refusals):
            count = error_frames + errors - self._errors
            items.append(CanErrors(count, refusals - self._refusals))
            self._errors, self._refusals = errors, refusals
        return tuple(items)
