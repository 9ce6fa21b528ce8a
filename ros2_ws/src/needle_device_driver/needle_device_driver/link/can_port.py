"""The CAN bus behind whatever adapter there is: a port with a thread that opens and reads it."""

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

_RECEIVE_WAIT = 0.05
_JOIN_WAIT = 1.0
_OPEN_AGAIN = 0.1
# An adapter from which nothing comes for so long may have started meanwhile, its channel closed.
_SILENCE = 0.4
_LARGEST_BATCH = 50

Batch = tuple[CanFrame | CanErrors, ...]


def open_bus(settings: LinkSettings) -> can.BusABC:
    """Open the adapter; raises what python-can and the operating system have."""
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


def _plainly(error: Exception) -> str:
    """Return an error as a person reads it: the system's own word where it has one."""
    for cause in (error, error.__cause__, error.__context__):
        if isinstance(cause, OSError) and cause.errno is not None:
            return os.strerror(cause.errno)
    return str(error).partition("\n")[0]


class CanPort:
    """A CAN bus behind an adapter, which its thread opens, reads, and opens again when it is lost.

    Parameters
    ----------
    settings : LinkSettings
        Which adapter.
    clock : callable
        Steady time [s].
    """

    def __init__(self, settings: LinkSettings, clock: Callable[[], float] = time.monotonic) -> None:
        self._settings = settings
        self._clock = clock
        self._closed = threading.Event()
        self._heard_at = 0.0
        # Of the adapter: the thread greets it while others send.
        self._lock = threading.Lock()
        self._bus: can.BusABC | None = None
        self._errors = self._refusals = 0
        self._told: PortChange | None = None
        self._thread = threading.Thread(target=self._run, name="can-receive", daemon=True)

    def open(self, arrive: Callable[[Batch | PortChange], None]) -> None:
        """Begin, with one attempt at once; `arrive` is called by whatever thread."""
        self.begin(arrive)
        self._thread.start()

    def begin(self, arrive: Callable[[Batch | PortChange], None]) -> None:
        """Open the adapter as `open` does, and leave it to the caller to `step`."""
        self._arrive = arrive
        self._open()

    def send(self, frames: tuple[CanFrame, ...]) -> None:
        """Send frames; an adapter that takes none for `write_timeout` is lost, and that is told."""
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
        """Let go of the adapter. May be called twice."""
        self._closed.set()
        if self._thread.is_alive():
            self._thread.join(_JOIN_WAIT)
        with self._lock:
            self._let_go()

    def _tell(self, change: PortChange) -> None:
        if change != self._told:
            self._told = change
            self._arrive(change)

    def _open(self) -> None:
        try:
            bus = open_bus(self._settings)
        except (can.CanError, OSError, ValueError) as error:
            self._tell(PortChange(_plainly(error)))
            return
        self._errors = self._refusals = 0
        self._bus, self._heard_at = bus, self._clock()
        self._tell(PortChange())

    def _lose(self, error: Exception) -> None:
        """Let go of an adapter that failed, once."""
        if self._bus is not None:
            self._let_go()
            self._tell(PortChange(_plainly(error)))

    def _let_go(self) -> None:
        bus, self._bus = self._bus, None
        if bus is None:
            return
        # What is lost cannot be told to close.
        with contextlib.suppress(can.CanError, OSError):
            bus.shutdown()
        if isinstance(bus, SlcanBus):
            # Its shutdown tells the adapter first and keeps the port open where that fails.
            with contextlib.suppress(OSError):
                bus.serialPortOrig.close()

    # ---- the thread -----------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._closed.is_set():
            self.step()

    def step(self) -> None:
        """Hand on what is there, once something is or a while is over; open what is lost."""
        bus = self._bus
        if bus is None:
            if not self._closed.wait(_OPEN_AGAIN):
                self._open()
            return
        try:
            batch = self._receive(bus)
            if batch:
                self._heard_at = self._clock()
                self._arrive(batch)
            if self._clock() - self._heard_at > _SILENCE and isinstance(bus, SlcanBus):
                self._heard_at = self._clock()
                with self._lock:
                    bus.greet()
        # python-can's adapters raise what their operating system has.
        except Exception as error:  # noqa: BLE001
            with self._lock:
                if self._bus is bus:
                    self._lose(error)

    def _receive(self, bus: can.BusABC) -> Batch:
        """Return what is there, once something is or a while is over."""
        items: list[CanFrame | CanErrors] = []
        message, error_frames = bus.recv(_RECEIVE_WAIT), 0
        while message is not None:
            if message.is_error_frame:
                error_frames += 1
            elif not (message.is_remote_frame or message.is_extended_id):
                frame = CanFrame(message.arbitration_id, bytes(message.data), time=self._clock())
                items.append(frame)
            message = bus.recv(0.0) if len(items) < _LARGEST_BATCH else None
        errors = bus.malformed if isinstance(bus, SlcanBus | SocketcandBus) else 0
        refusals = bus.refused if isinstance(bus, SlcanBus) else 0
        if error_frames or (errors, refusals) != (self._errors, self._refusals):
            count = error_frames + errors - self._errors
            items.append(CanErrors(count, refusals - self._refusals))
            self._errors, self._refusals = errors, refusals
        return tuple(items)
