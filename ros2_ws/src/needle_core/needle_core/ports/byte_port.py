"""Port on a stream of bytes, such as a TCP connection."""

from __future__ import annotations

import socket
from typing import Protocol

from needle_core.ports.reopening_port import ReopeningPort

MAX_CHUNK = 65536
"""Maximum number of bytes per read."""


class ByteStream(Protocol):
    """Serial line or TCP connection; a loss raises an OSError."""

    def read(self) -> bytes:
        """Wait a short time for bytes and return them."""

    def write(self, data: bytes) -> None:
        """Write all bytes."""

    def close(self) -> None:
        """Close the stream."""


class TcpStream:
    """TCP connection as a `ByteStream`; a read or write waits at most `timeout` [s]."""

    def __init__(self, connection: socket.socket, timeout: float) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.settimeout(timeout)
        self.write, self.close = connection.sendall, connection.close
        self._receive = connection.recv

    def read(self) -> bytes:
        """Wait a short time for bytes and return them."""
        try:
            data = self._receive(MAX_CHUNK)
        except TimeoutError:
            return b""
        if not data:
            raise ConnectionResetError("closed by the other end")
        return data


class BytePort(ReopeningPort[ByteStream]):
    """Port on a stream that a subclass opens."""

    def _read(self, device: ByteStream) -> tuple[bytes, ...]:
        data = device.read()
        return (data,) if data else ()

    def _write(self, device: ByteStream, batch: tuple[bytes, ...]) -> None:
        device.write(b"".join(batch))

    def _close_device(self, device: ByteStream) -> None:
        device.close()
