"""Drives that answer requests: their cycle, and the backend of a protocol."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from needle_device_driver.axes.axis import PERIOD
from needle_device_driver.axes.axis_settings import AxisSettings
from needle_device_driver.axes.backend import Backend
from needle_device_driver.axes.drives import Drives
from needle_device_driver.axes.link import DriveError, LinkError
from needle_device_driver.polled.drive_protocol import DriveProtocol, DriveReply
from needle_device_driver.polled.polled_axis import PolledAxis
from needle_device_driver.polled.text_link import StreamPort, TextLink
from needle_device_driver.procedure import Procedure, Wait

_NUMBERS = 99
# A request that is not answered within this number of cycles is lost. Until then no other is sent:
# requests must not pile up on a slow line, and one lost answer does not make a drive silent.
_LOST_AFTER = 3
_REFRESH_TIMEOUT = 0.5
_EMULATED = "Emulated"


class PolledDrives(Drives):
    """All drives of a protocol behind one connection.

    Parameters
    ----------
    port : str
        Name of the component's port.
    protocol : DriveProtocol
    Protocol of the drives.
    """

    def __init__(self, port: str, protocol: DriveProtocol) -> None:
        axes = {
            name: PolledAxis(name, settings, protocol, self._refresh)
            for name, settings in protocol.axes.items()
        }
        super().__init__(port, protocol.link, axes)
        self.capabilities = protocol.capabilities
        self.protocol, self._link, self._axes = protocol, protocol.link, axes
        protocol.on_status = self._on_status
        self._identity = ""
        self._number = 0
        # Time of the last request [s], and whether its answer is missing.
        self._requested_at = 0.0
        self._is_waiting = False

    def receive(self, batch: Sequence[bytes]) -> None:
        """Receive bytes from the port."""
        for line in self._link.receive(batch):
            self.protocol.on_line(line)

    def _identify(self) -> Procedure[None]:
        self._is_waiting = False
        self._identity = yield from self.protocol.identify()

    def are_emulated(self) -> Procedure[bool]:
        """Return whether the drives report that they are emulated."""
        yield from ()
        return self._identity.startswith(_EMULATED)

    def beat(self) -> None:
        """Feed the watchdogs if the link is open."""
        if self._link.is_open:
            self.protocol.beat()

    def _answered(self) -> bool:
        return not self._is_waiting

    def _request(self, timeout: float) -> float:
        now = self._link.now
        if not self._is_waiting or now - self._requested_at > (_LOST_AFTER - 0.5) * PERIOD:
            self._number = self._number % _NUMBERS + 1
            self._requested_at, self._is_waiting = now, True
            self.protocol.request(self._number)
        self._mark_answered()
        return timeout

    def _on_status(self, number: int, replies: Mapping[str, DriveReply]) -> None:
        if number != self._number or not self._is_waiting:
            # Answers a request from before the link was opened, or one that counts as lost.
            return
        self._is_waiting = False
        for name, reply in replies.items():
            self._axes[name].update(reply, self._requested_at)
        self._mark_answered()

    def _mark_answered(self) -> None:
        for axis in self._axes.values():
            axis.answered = not self._is_waiting

    def _refresh(self) -> Procedure[None]:
        """Request the state of all drives, and wait for it.

        Raises
        ------
        DriveError
            If there is no answer.
        LinkError
            If the link is lost.
        """
        self._is_waiting = False
        yield Wait(
            lambda: bool(self._link.lost) or self._answered(), self._request(_REFRESH_TIMEOUT)
        )
        if self._link.lost:
            raise LinkError(self._link.lost)
        if self._is_waiting:
            raise DriveError(f"{self._link.name}: no state in {_REFRESH_TIMEOUT:g} s")


def polled_backend(
    port: str,
    settings: type[Any],
    protocol: type[DriveProtocol],
    *,
    address: Callable[[Any], str],
    baudrate: Callable[[Any], int] = lambda _: 115_200,
) -> Backend:
    """Return the backend of a protocol.

    Parameters
    ----------
    port : str
        Name of the backend, and of its port.
    settings : type
        Dataclass of its parameters.
    protocol : type
    Protocol of the drives.
    address, baudrate : callable
        Return device file or `host:port`, and the speed of a serial line, from the parameters.
    """

    def make(parameters: Any, axes: Mapping[str, AxisSettings]) -> PolledDrives:
        link = TextLink(f"{port} {address(parameters)}", protocol.terminators)
        return PolledDrives(port, protocol(parameters, axes, link))

    def open_port(parameters: Any) -> StreamPort:
        return StreamPort(address(parameters), baudrate(parameters), parameters.write_timeout)

    return Backend(port, settings, make, open_port)
