"""Connection that carries lines of text: port, and link of the component."""

from __future__ import annotations

import contextlib
import re
import socket
from collections.abc import Sequence

import serial

from needle_core.ports.byte_port import MAX_CHUNK, BytePort, ByteStream, TcpStream
from needle_device_driver.axes.link import Link

_CONNECT_TIMEOUT, _READ_TIMEOUT = 1.0, 0.05


class _Serial:
    def __init__(self, path: str, baudrate: int, timeout: float) -> None:
        self._serial = serial.Serial(
            path, baudrate, timeout=_READ_TIMEOUT, write_timeout=timeout, exclusive=True
        )
        # Adapters with an FTDI chip otherwise buffer answers for 16 ms.
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
        Baud rate of a serial device [bit/s].
    write_timeout : float
        A stream that accepts no bytes for this time counts as lost [s].
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


# Longer lines [bytes] are noise or data of another program.
_LONGEST_LINE = 1024


class TextLink(Link):
    """A connection that passes bytes.

    Parameters
    ----------
    name : str
        Name of the link in messages.
    terminators : bytes
        Each of these bytes ends a line.

    Attributes
    ----------
    bytes_sent, lines_received, garbled : int
        Counters; garbled lines are not ASCII text, or too long.
    """

    _counters = ("bytes_sent", "lines_received", "garbled")

    def __init__(self, name: str, terminators: bytes) -> None:
        super().__init__(name)
        self.bytes_sent = self.lines_received = self.garbled = 0
        # Position after a terminator.
        self._line_end = re.compile(b"(?<=[" + re.escape(terminators) + b"])")
        self._rest = b""
        self._outgoing = b""

    def send(self, data: bytes) -> None:
        """Add bytes to the outgoing batch of the running handler.

        Raises
        ------
        LinkError
            If the link is closed or lost.
        """
        self._require_open()
        self._outgoing += data
        self.bytes_sent += len(data)

    def pop_outgoing(self) -> tuple[bytes, ...]:
        """Return the bytes that were sent since the last call."""
        data, self._outgoing = self._outgoing, b""
        return (data,) if data else ()

    def receive(self, chunks: Sequence[bytes]) -> list[str]:
        """Return the lines that are complete with these chunks, each with its terminator."""
        if not self.is_open:
            return []
        *lines, self._rest = self._line_end.split(self._rest + b"".join(chunks))
        if len(self._rest) > _LONGEST_LINE:
            lines, self._rest = [*lines, self._rest], b""
        texts = [
            line[:-1].decode().strip() + chr(line[-1])
            for line in lines
            if line.isascii() and len(line) <= _LONGEST_LINE
        ]
        self.garbled += len(lines) - len(texts)
        self.lines_received += len(texts)
        return texts

    def _restart(self) -> None:
        self._rest = b""
