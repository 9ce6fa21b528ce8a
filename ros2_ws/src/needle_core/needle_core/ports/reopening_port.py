"""Port whose thread opens a device, reads from it, and reopens it after a loss."""

from __future__ import annotations

import abc
import contextlib
import os
import threading
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from needle_core.component import PortChange

D = TypeVar("D")
_REOPEN_PERIOD = 0.1
_JOIN_TIMEOUT = 1.0


class ReopeningPort(abc.ABC, Generic[D]):
    """Port on a device of type `D`.

    Parameters
    ----------
    errors : tuple of type
        Exceptions that opening the device or writing to it may raise.
    """

    def __init__(self, errors: tuple[type[Exception], ...] = (OSError,)) -> None:
        self._errors_of_device = errors
        self._closed = threading.Event()
        # Protects the device: the thread may set it up while another thread sends.
        self._lock = threading.Lock()
        self._device: D | None = None
        self._reported: PortChange | None = None
        self._thread = threading.Thread(target=self._run, name="port-receive", daemon=True)

    def open(self, arrive: Callable[[Any], None]) -> None:
        """Try once to open the device, then start the thread; any thread may call `arrive`."""
        self.begin(arrive)
        self._thread.start()

    def begin(self, arrive: Callable[[Any], None]) -> None:
        """Open the device without starting the thread; the caller calls `step` instead."""
        self._arrive = arrive
        self._try_to_open()

    def send(self, batch: tuple[Any, ...]) -> None:
        """Send a batch, or drop it if no device is open; an error closes the device."""
        with self._lock:
            device = self._device
            if device is None:
                return
            try:
                self._write(device, batch)
            except self._errors_of_device as error:
                self._lose(error)

    def close(self) -> None:
        """End the thread and close the device. May be called twice."""
        self._closed.set()
        if self._thread.is_alive():
            self._thread.join(_JOIN_TIMEOUT)
        with self._lock:
            self._shut_down()

    def step(self) -> None:
        """Wait a short time for input and pass it on; reopen a lost device."""
        device = self._device
        if device is None:
            if not self._closed.wait(_REOPEN_PERIOD):
                self._try_to_open()
            return
        try:
            if batch := self._read(device):
                self._arrive(batch)
        # Device libraries also raise exceptions other than the declared ones.
        except Exception as error:  # noqa: BLE001
            with self._lock:
                if self._device is device:
                    self._lose(error)

    @abc.abstractmethod
    def _open_device(self) -> D:
        """Return the open device."""

    @abc.abstractmethod
    def _read(self, device: D) -> tuple[Any, ...]:
        """Wait a short time for input and return it."""

    @abc.abstractmethod
    def _write(self, device: D, batch: tuple[Any, ...]) -> None:
        """Write a batch within the duration of one cycle."""

    @abc.abstractmethod
    def _close_device(self, device: D) -> None:
        """Close the device; errors of the device are ignored."""

    def _run(self) -> None:
        while not self._closed.is_set():
            self.step()

    def _report(self, change: PortChange) -> None:
        if change != self._reported:
            self._reported = change
            self._arrive(change)

    def _try_to_open(self) -> None:
        try:
            self._device = self._open_device()
        except self._errors_of_device as error:
            self._report(PortChange(_error_text(error)))
            return
        self._report(PortChange())

    def _lose(self, error: Exception) -> None:
        """Close a device that failed, and report the loss once."""
        self._shut_down()
        self._report(PortChange(_error_text(error)))

    def _shut_down(self) -> None:
        device, self._device = self._device, None
        if device is not None:
            with contextlib.suppress(*self._errors_of_device):
                self._close_device(device)


def _error_text(error: Exception) -> str:
    """Return a one-line description of an error: the operating system's text if there is one."""
    context = None if error.__suppress_context__ else error.__context__
    for cause in (error, error.__cause__, context):
        # Failed host name look-ups have negative numbers that strerror does not know.
        if isinstance(cause, OSError) and cause.errno and cause.errno > 0:
            return os.strerror(cause.errno)
    return str(error).partition("\n")[0]
