"""The CAN bus behind whatever adapter there is: a port with a thread that opens and reads it."""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
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

Item = CanFrame | CanErrors | PortChange


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
    """A CAN bus behind an adapter, from the first attempt to open it.

    Its thread gives frames their time of arrival; what is lost is opened again until it is there.

    Parameters
    ----------
    settings : LinkSettings
        Which adapter.
    clock : callable
        Steady time [s].
    wake : callable
        Called, by whatever thread, when there is something to take.
    """

    def __init__(
        self, settings: LinkSettings, clock: Callable[[], float], wake: Callable[[], None]
    ) -> None:
        self._settings = settings
        self._clock = clock
        self._wake = wake
        self._items: deque[Item] = deque()
        self._there = threading.Event()
        self._closed = threading.Event()
        # Of the adapter: the thread greets it while others send.
        self._lock = threading.Lock()
        self._bus: can.BusABC | None = None
        self._errors = self._refusals = 0
        self._told: PortChange | None = None
        self._open()
        self._thread = threading.Thread(target=self._run, name="can-receive", daemon=True)
        self._thread.start()

    def take(self) -> list[Item]:
        """Return what has come since the last call, oldest first."""
        self._there.clear()
        return [self._items.popleft() for _ in range(len(self._items))]

    def wait(self, seconds: float) -> None:
        """Wait until there is something to take, at most so long."""
        self._there.wait(seconds)

    def send(self, frames: tuple[CanFrame, ...]) -> None:
        """Send frames; an adapter that takes none of them is lost, and told so."""
        with self._lock:
            bus = self._bus
            try:
                for frame in frames if bus is not None else ():
                    assert bus is not None
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
        self._thread.join(_JOIN_WAIT)
        with self._lock:
            self._let_go()

    def _hand_on(self, item: Item) -> None:
        self._items.append(item)
        self._there.set()
        self._wake()

    def _tell(self, change: PortChange) -> None:
        if change != self._told:
            self._told = change
            self._hand_on(change)

    def _open(self) -> None:
        try:
            bus = open_bus(self._settings)
        except (can.CanError, OSError, ValueError) as error:
            self._tell(PortChange(_plainly(error)))
            return
        self._errors = self._refusals = 0
        self._bus = bus
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
        heard_at = self._clock()
        while not self._closed.is_set():
            bus = self._bus
            if bus is None:
                self._closed.wait(_OPEN_AGAIN)
                if not self._closed.is_set():
                    self._open()
                    heard_at = self._clock()
                continue
            try:
                message = bus.recv(_RECEIVE_WAIT)
                if message is not None:
                    heard_at = self._clock()
                    self._take(message, heard_at)
                self._count(bus)
                if self._clock() - heard_at > _SILENCE and isinstance(bus, SlcanBus):
                    heard_at = self._clock()
                    with self._lock:
                        bus.greet()
            # python-can's adapters raise what their operating system has.
            except Exception as error:  # noqa: BLE001
                with self._lock:
                    if self._bus is bus:
                        self._lose(error)

    def _take(self, message: can.Message, now: float) -> None:
        if message.is_error_frame:
            self._hand_on(CanErrors(1))
        elif not (message.is_remote_frame or message.is_extended_id):
            self._hand_on(CanFrame(message.arbitration_id, bytes(message.data), time=now))

    def _count(self, bus: can.BusABC) -> None:
        """Hand on what the adapter has counted."""
        errors = bus.malformed if isinstance(bus, SlcanBus | SocketcandBus) else 0
        refusals = bus.refused if isinstance(bus, SlcanBus) else 0
        if (errors, refusals) != (self._errors, self._refusals):
            self._hand_on(CanErrors(errors - self._errors, refusals - self._refusals))
            self._errors, self._refusals = errors, refusals
