"""The CAN bus behind whatever adapter there is: opened, watched, named when it is lost."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable

import can

from needle_device_driver.link.frame_link import FrameLink, LinkError
from needle_device_driver.link.link_settings import LinkSettings
from needle_device_driver.link.slcan_bus import SlcanBus
from needle_device_driver.link.socketcand_bus import SocketcandBus
from needle_device_driver.procedure import Procedure, T, run

_RECEIVE_WAIT = 0.05
_JOIN_WAIT = 1.0
# An adapter from which nothing comes for so long may have started meanwhile, its channel closed.
_SILENCE = 0.4


def open_bus(settings: LinkSettings) -> can.BusABC:
    """Open the adapter.

    Raises
    ------
    LinkError
        If it is not there or does not take the settings.
    """
    try:
        if settings.kind == "slcan":
            return SlcanBus(
                settings.channel,
                bitrate=settings.bitrate,
                tty_baudrate=settings.tty_baudrate,
                write_timeout=settings.write_timeout,
            )
        if settings.kind == "socketcand":
            return SocketcandBus(
                settings.channel,
                host=settings.host,
                port=settings.port,
                write_timeout=settings.write_timeout,
            )
        return can.Bus(interface=settings.kind, channel=settings.channel)
    except (can.CanError, OSError, ValueError) as error:
        raise LinkError(f"cannot open {settings}: {_plainly(error)}") from error


def _plainly(error: Exception) -> str:
    """Return an error as a person reads it: the system's own word where it has one."""
    for cause in (error, error.__cause__, error.__context__):
        if isinstance(cause, OSError) and cause.errno is not None:
            return os.strerror(cause.errno)
    return str(error).partition("\n")[0]


class CanLink(FrameLink):
    """A CAN bus behind an adapter.

    Frames are received in a thread of their own, so that their arrival has its true time; a loop
    that hangs sends nothing.

    Parameters
    ----------
    settings : LinkSettings
        Which adapter.
    clock : callable
        Steady time [s].
    open_bus : callable
        Opens the adapter.
    """

    def __init__(
        self,
        settings: LinkSettings,
        clock: Callable[[], float],
        open_bus: Callable[[LinkSettings], can.BusABC] = open_bus,
    ) -> None:
        super().__init__(settings, clock)
        self._open_bus = open_bus
        self._bus: can.BusABC | None = None
        self._thread: threading.Thread | None = None
        self._heard_at = 0.0

    @property
    def is_open(self) -> bool:
        """Tell whether the adapter is open, as far as anybody knows."""
        return self._bus is not None and not self.lost

    @property
    def errors(self) -> int:
        """Number of error frames, lines and process data that are none, and refused frames."""
        bus = self._bus
        own = bus.malformed if isinstance(bus, SlcanBus | SocketcandBus) else 0
        return self.error_frames + own + self.refused

    @property
    def refused(self) -> int:
        """Number of commands and frames that the adapter did not take; slcan only."""
        return self._bus.refused if isinstance(self._bus, SlcanBus) else 0

    def open(self) -> None:
        """Open the adapter and begin to receive; a lost one is opened anew.

        A serial adapter that is silent is told bitrate and "open" again: many start when their port
        is opened, and hear nothing meanwhile.

        Raises
        ------
        LinkError
            If that is not possible.
        """
        if self.is_open:
            self._greet_again()
            return
        self.close()
        bus = self._open_bus(self.settings)
        self._note_opening()
        self._bus = bus
        self._heard_at = self.clock()
        self._begin_to_receive(bus)

    def close(self) -> None:
        """Let go of the adapter. May be called twice."""
        bus, self._bus = self._bus, None
        if self._thread is not None:
            self._thread.join(_JOIN_WAIT)
            self._thread = None
        if bus is not None:
            # What is lost cannot be told to close.
            with contextlib.suppress(can.CanError, OSError):
                bus.shutdown()
            _close_port(bus)

    def send(self, cob_id: int, data: bytes = b"") -> None:
        """Send one frame.

        Raises
        ------
        LinkError
            If the link is closed or lost.
        """
        if self.lost:
            raise LinkError(self.lost)
        if self._bus is None:
            raise LinkError(f"{self.settings} is not open")
        try:
            self._bus.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))
        except (can.CanError, OSError) as error:
            self._lose(error)
            raise LinkError(self.lost) from error
        self.frames_sent += 1

    def run(self, procedure: Procedure[T]) -> T:
        """Run a procedure to its end; frames are received meanwhile."""
        return run(procedure, self._wait_for, self.clock)

    def _begin_to_receive(self, bus: can.BusABC) -> None:
        self._thread = threading.Thread(
            target=self._receive, args=(bus,), name="can-receive", daemon=True
        )
        self._thread.start()

    def _wait_for(self, predicate: Callable[[], bool], timeout: float) -> bool:
        with self.arrival:
            return self.arrival.wait_for(predicate, timeout)

    def _greet_again(self) -> None:
        bus = self._bus
        if not isinstance(bus, SlcanBus) or self.clock() - self._heard_at < _SILENCE:
            return
        self._heard_at = self.clock()
        try:
            bus.greet()
        except can.CanError as error:
            self._lose(error)
            raise LinkError(self.lost) from error

    def _lose(self, error: Exception) -> None:
        with self.arrival:
            if not self.lost:
                self.lost = f"link {self.settings} is lost: {_plainly(error)}"
            self.arrival.notify_all()

    def _receive(self, bus: can.BusABC) -> None:
        while self._bus is bus and not self.lost:
            try:
                message = bus.recv(_RECEIVE_WAIT)
            # python-can's adapters raise what their operating system has.
            except Exception as error:  # noqa: BLE001
                if self._bus is bus:
                    self._lose(error)
                return
            if message is not None:
                self._dispatch(message)

    def _dispatch(self, message: can.Message) -> None:
        if message.is_error_frame:
            self.error_frames += 1
            return
        if message.is_remote_frame or message.is_extended_id:
            return
        self._heard_at = self.clock()
        self._take(message.arbitration_id, bytes(message.data), self._heard_at)


def _close_port(bus: can.BusABC) -> None:
    # slcan's shutdown tells the adapter first and keeps the port open where that fails.
    if isinstance(bus, SlcanBus):
        with contextlib.suppress(OSError):
            bus.serialPortOrig.close()
