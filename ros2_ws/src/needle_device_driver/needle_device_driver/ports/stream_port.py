"""Port on a stream of bytes, serial or TCP: a thread opens it, reads, and reopens a lost one."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections.abc import Callable
from typing import Any, Protocol

import serial

from needle_core.component import PortChange

_CONNECT_TIMEOUT, _READ_TIMEOUT = 1.0, 0.05
_REOPEN_PERIOD = 0.1
_JOIN_TIMEOUT = 1.0
_MAX_CHUNK = 4096


class _Stream(Protocol):
    def read(self) -> bytes: ...
    def write(self, data: bytes) -> None: ...
    def close(self) -> None: ...


class _Tcp:
    def __init__(self, host: str, port: int, timeout: float) -> None:
        self._socket = socket.create_connection((host, port), timeout=_CONNECT_TIMEOUT)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.settimeout(timeout)

    def read(self) -> bytes:
        try:
            data = self._socket.recv(_MAX_CHUNK)
        except TimeoutError:
            return b""
        if not data:
            raise ConnectionResetError("closed by the drive")
        return data

    def write(self, data: bytes) -> None:
        self._socket.sendall(data)

    def close(self) -> None:
        self._socket.close()


class _Serial:
    def __init__(self, path: str, baudrate: int, write_timeout: float) -> None:
        self._serial = serial.Serial(
            path, baudrate, timeout=_READ_TIMEOUT, write_timeout=write_timeout, exclusive=True
        )

    def read(self) -> bytes:
        return bytes(self._serial.read(max(1, min(self._serial.in_waiting, _MAX_CHUNK))))

    def write(self, data: bytes) -> None:
        self._serial.write(data)

    def close(self) -> None:
        self._serial.close()


class StreamPort:
    """Port on a serial device or a TCP server.

    Parameters
    ----------
    address : str
        Device file, or `host:port`.
    baudrate : int
        Of a serial device [bit/s].
    write_timeout : float
        A stream that accepts no bytes for this time is lost [s].
    """

    def __init__(self, address: str, baudrate: int, write_timeout: float) -> None:
        self._address, self._baudrate, self._write_timeout = address, baudrate, write_timeout
        self._closed = threading.Event()
        self._stream: _Stream | None = None
        self._reported: PortChange | None = None
        self._thread = threading.Thread(target=self._run, name="stream-receive", daemon=True)

    def open(self, arrive: Callable[[Any], None]) -> None:
        """Try once to open the stream, then start the thread; any thread may call `arrive`."""
        self.begin(arrive)
        self._thread.start()

    def begin(self, arrive: Callable[[Any], None]) -> None:
        """Open the stream without the thread; the caller calls `step`."""
        self._arrive = arrive
        self._try_to_open()

    def send(self, batch: tuple[bytes, ...]) -> None:
        """Send bytes; without a stream they are dropped, and an error loses the stream."""
        stream = self._stream
        if stream is None:
            return
        try:
            stream.write(b"".join(batch))
        except OSError as error:
            self._lose(stream, error)

    def close(self) -> None:
        """End the thread and close the stream."""
        self._closed.set()
        if self._thread.is_alive():
            self._thread.join(_JOIN_TIMEOUT)
        if self._stream is not None:
            self._stream.close()

    def _run(self) -> None:
        while not self._closed.is_set():
            self.step()

    def step(self) -> None:
        """Wait a short time for bytes and pass them on; reopen a lost stream."""
        stream = self._stream
        if stream is None:
            if not self._closed.wait(_REOPEN_PERIOD):
                self._try_to_open()
            return
        try:
            data = stream.read()
        # A stream that another thread closes raises TypeError in pyserial.
        except (OSError, TypeError) as error:
            self._lose(stream, error)
            return
        if data:
            self._arrive((data,))

    def _try_to_open(self) -> None:
        host, colon, port = self._address.rpartition(":")
        try:
            self._stream = (
                _Tcp(host, int(port), self._write_timeout)
                if colon and port.isdigit()
                else _Serial(self._address, self._baudrate, self._write_timeout)
            )
        except OSError as error:
            self._report(PortChange(_text(error)))
            return
        self._report(PortChange())

    def _lose(self, stream: _Stream, error: Exception) -> None:
        if self._stream is stream:
            self._stream = None
            with contextlib.suppress(OSError):
                stream.close()
            self._report(PortChange(_text(error)))

    def _report(self, change: PortChange) -> None:
        if change != self._reported:
            self._reported = change
            self._arrive(change)


def _text(error: Exception) -> str:
    """Return one line on an error: the operating system's text if there is one."""
    number = getattr(error, "errno", None)
    return os.strerror(number) if number else str(error).partition("\n")[0]
