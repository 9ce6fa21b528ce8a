"""Port on a CAN bus: a thread opens the adapter, receives frames, and reopens a lost adapter."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable

import can

from needle_core.can_frame import CanErrors, CanFrame
from needle_core.component import PortChange
from needle_device_driver.link.link_settings import LinkSettings
from needle_device_driver.link.slcan_bus import SlcanBus
from needle_device_driver.link.socketcand_bus import SocketcandBus

_RECEIVE_TIMEOUT = 0.05
_JOIN_TIMEOUT = 1.0
_REOPEN_PERIOD = 0.1
# A silent adapter may have restarted with its channel closed; after this time it is set up again.
_SILENCE = 0.4
_MAX_BATCH = 50

Batch = tuple[CanFrame | CanErrors, ...]


def open_bus(settings: LinkSettings, write_timeout: float) -> can.BusABC:
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


def _error_text(error: Exception) -> str:
    """Return one line on an error: the operating system's text if there is one."""
    for cause in (error, error.__cause__, error.__context__):
        if isinstance(cause, OSError) and cause.errno is not None:
            return os.strerror(cause.errno)
    return str(error).partition("\n")[0]


class CanPort:
    """Port on a CAN bus.

    Parameters
    ----------
    settings : LinkSettings
        The adapter.
    write_timeout : float
        An adapter that accepts no frame for this time is lost [s].
    clock : callable
        Returns the steady time [s].
    """

    def __init__(
        self,
        settings: LinkSettings,
        write_timeout: float = 0.05,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._settings = settings
        self._write_timeout = write_timeout
        self._clock = clock
        self._closed = threading.Event()
        self._received_at = 0.0
        # Protects the adapter: the thread may set it up while another thread sends.
        self._lock = threading.Lock()
        self._bus: can.BusABC | None = None
        self._errors = self._refusals = 0
        self._reported: PortChange | None = None
        self._thread = threading.Thread(target=self._run, name="can-receive", daemon=True)

    def open(self, arrive: Callable[[Batch | PortChange], None]) -> None:
        """Try once to open the adapter, then start the thread; any thread may call `arrive`."""
        self.begin(arrive)
        self._thread.start()

    def begin(self, arrive: Callable[[Batch | PortChange], None]) -> None:
        """Open the adapter without the thread; the caller calls `step`."""
        self._arrive = arrive
        self._open()

    def send(self, frames: tuple[CanFrame, ...]) -> None:
        """Send frames; without an adapter they are dropped, and an error loses the adapter."""
        with self._lock:
            bus = self._bus
            if bus is None:
                return
            try:
                for frame in frames:
                    bus.send(
                        can.Message(
                            arbitration_id=frame.identifier, data=frame.data, is_extended_id=False
                        )
                    )
            except (can.CanError, OSError) as error:
                self._lose(error)

    def close(self) -> None:
        """End the thread and close the adapter. May be called twice."""
        self._closed.set()
        if self._thread.is_alive():
            self._thread.join(_JOIN_TIMEOUT)
        with self._lock:
            self._shut_down()

    def _report(self, change: PortChange) -> None:
        if change != self._reported:
            self._reported = change
            self._arrive(change)

    def _open(self) -> None:
        try:
            bus = open_bus(self._settings, self._write_timeout)
        except (can.CanError, OSError, ValueError) as error:
            self._report(PortChange(_error_text(error)))
            return
        self._errors = self._refusals = 0
        self._bus, self._received_at = bus, self._clock()
        self._report(PortChange())

    def _lose(self, error: Exception) -> None:
        """Close an adapter that failed, and report the loss once."""
        if self._bus is not None:
            self._shut_down()
            self._report(PortChange(_error_text(error)))

    def _shut_down(self) -> None:
        bus, self._bus = self._bus, None
        if bus is None:
            return
        # A lost adapter cannot execute the command to close its channel.
        with contextlib.suppress(can.CanError, OSError):
            bus.shutdown()
        if isinstance(bus, SlcanBus):
            # Where that command fails, python-can leaves the serial port open.
            with contextlib.suppress(OSError):
                bus.serialPortOrig.close()

    # ---- the thread -----------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._closed.is_set():
            self.step()

    def step(self) -> None:
        """Wait a short time for frames and pass them on; reopen a lost adapter."""
        bus = self._bus
        if bus is None:
            if not self._closed.wait(_REOPEN_PERIOD):
                self._open()
            return
        try:
            batch = self._receive(bus)
            if batch:
                self._received_at = self._clock()
                self._arrive(batch)
            if self._clock() - self._received_at > _SILENCE and isinstance(bus, SlcanBus):
                self._received_at = self._clock()
                with self._lock:
                    bus.set_up_channel()
        # python-can's adapters raise whatever their operating system raises.
        except Exception as error:  # noqa: BLE001
            with self._lock:
                if self._bus is bus:
                    self._lose(error)

    def _receive(self, bus: can.BusABC) -> Batch:
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
