"""Port on a serial device or a TCP server."""

from __future__ import annotations

import contextlib
import socket

import serial

from needle_core.ports.byte_port import MAX_CHUNK, BytePort, ByteStream, TcpStream

_CONNECT_TIMEOUT, _READ_TIMEOUT = 1.0, 0.05


class _Serial:
    def __init__(self, path: str, baudrate: int, timeout: float) -> None:
        self._serial = serial.Serial(
            path, baudrate, timeout=_READ_TIMEOUT, write_timeout=timeout, exclusive=True
        )
        # Adapters with an FTDI chip otherwise collect answers for 16 ms.
        with contextlib.suppress(OSError, ValueError):
            self._serial.set_low_latency_mode(True)
        self.write, self.close = self._serial.write, self._serial.close

    def read(self) -> bytes:
        return bytes(self._serial.read(max(1, min(self._serial.in_waiting, MAX_CHUNK))))


class StreamPort(BytePort):
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
        super().__init__()
        self._address, self._baudrate, self._timeout = address, baudrate, write_timeout

    def _open_device(self) -> ByteStream:
        host, colon, port = self._address.rpartition(":")
        if colon and port.isdigit():
            connection = socket.create_connection((host, int(port)), timeout=_CONNECT_TIMEOUT)
            return TcpStream(connection, self._timeout)
        return _Serial(self._address, self._baudrate, self._timeout)
