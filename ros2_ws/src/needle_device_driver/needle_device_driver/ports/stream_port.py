"""Port on a stream of bytes, serial or TCP."""

from __future__ import annotations

import contextlib
import socket
from typing import Protocol

import serial

from needle_device_driver.ports.reopening_port import ReopeningPort

_CONNECT_TIMEOUT, _READ_TIMEOUT = 1.0, 0.05
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
    def __init__(self, path: str, baudrate: int, timeout: float) -> None:
        self._serial = serial.Serial(
            path, baudrate, timeout=_READ_TIMEOUT, write_timeout=timeout, exclusive=True
        )
        # Adapters with an FTDI chip otherwise collect answers for 16 ms.
        with contextlib.suppress(OSError, ValueError):
            self._serial.set_low_latency_mode(True)

    def read(self) -> bytes:
        return bytes(self._serial.read(max(1, min(self._serial.in_waiting, _MAX_CHUNK))))

    def write(self, data: bytes) -> None:
        self._serial.write(data)

    def close(self) -> None:
        self._serial.close()


class StreamPort(ReopeningPort[_Stream]):
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
        super().__init__((OSError,))
        self._address, self._baudrate, self._timeout = address, baudrate, write_timeout

    def _open_device(self) -> _Stream:
        host, colon, port = self._address.rpartition(":")
        if colon and port.isdigit():
            return _Tcp(host, int(port), self._timeout)
        return _Serial(self._address, self._baudrate, self._timeout)

    def _read(self, device: _Stream) -> tuple[bytes, ...]:
        data = device.read()
        return (data,) if data else ()

    def _write(self, device: _Stream, batch: tuple[bytes, ...]) -> None:
        device.write(b"".join(batch))

    def _close_device(self, device: _Stream) -> None:
        device.close()
