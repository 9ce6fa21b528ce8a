"""CAN adapters that speak text: serial ones (slcan), and socketcand over TCP."""

from __future__ import annotations

import abc
import contextlib
import errno
import os
import re
import select
import socket
import time
from collections import deque
from typing import ClassVar

import serial
from can import CanInitializationError, CanOperationError, Message
from can.interfaces.socketcand.socketcand import (
    convert_ascii_message_to_can_message,
    convert_can_message_to_ascii_message,
)

SLCAN_BITRATES = (
    *(10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 750_000, 1_000_000),
    83_300,
)
"""Bitrates of the slcan protocol, in the order of its commands S0 to S9 [bit/s]."""
# Longest time to connect to a server, and for each of its replies [s].
_CONNECT_TIMEOUT = 1.0
_REPLY_TIMEOUT = 1.0
# Longer lines [bytes] are noise.
_MAX_TEXT = 64
_MAX_READ = 4096


class TextBus(abc.ABC):
    """CAN bus behind a serial port or socket that carries text; it never blocks.

    python-can's own classes read a serial port byte by byte, which falls up to 0.8 s behind on a
    loaded machine, and wait for a stuck adapter or a silent server without a time-out.

    Parameters
    ----------
    device : serial.Serial or socket.socket
        The connection, non-blocking.
    write_timeout : float
        Longest wait of a write for free space [s].

    Attributes
    ----------
    malformed : int
        Number of malformed texts.
    refused : int
        Number of commands and frames that the adapter refused.
    """

    _end: ClassVar[re.Pattern[bytes]]
    """Position after a text."""

    def __init__(self, device: serial.Serial | socket.socket, write_timeout: float) -> None:
        self._device, self._write_timeout = device, write_timeout
        self._rest = b""
        self._texts: deque[str] = deque()
        self.malformed = self.refused = 0
        try:
            self.set_up_channel()
        except BaseException:
            device.close()
            raise

    @abc.abstractmethod
    def set_up_channel(self) -> None:
        """Open the CAN channel of the adapter."""

    def send(self, message: Message) -> None:
        """Send a frame.

        Raises
        ------
        CanOperationError
            If the adapter accepts no data.
        OSError
            If the connection is lost.
        """
        self._write(self._encode(message))

    def recv(self, timeout: float) -> Message | None:
        """Return the next frame; None if none arrives in this time [s]; raises as `send`."""
        until = time.monotonic() + timeout
        while (text := self._next_text(until)) is not None:
            try:
                if (message := self._decode(text)) is not None:
                    return message
            except (ValueError, IndexError):
                self.malformed += 1
        return None

    def shutdown(self) -> None:
        """Close the connection."""
        self._device.close()

    @abc.abstractmethod
    def _encode(self, message: Message) -> str:
        """Return the text of a frame."""

    @abc.abstractmethod
    def _decode(self, text: str) -> Message | None:
        """Return the frame in a line, None if it has none.

        Raises
        ------
        ValueError, IndexError
            If the line is malformed.
        """

    def _write(self, text: str) -> None:
        data, until = text.encode("ascii"), time.monotonic() + self._write_timeout
        while data:
            with contextlib.suppress(BlockingIOError):
                data = data[os.write(self._device.fileno(), data) :]
            wait = max(0.0, until - time.monotonic())
            if data and not select.select([], [self._device], [], wait)[1]:
                raise CanOperationError(f"accepted no data for {self._write_timeout:g} s")

    def _next_text(self, until: float) -> str | None:
        """Return the next text; None if none arrives until this steady time [s]."""
        while not self._texts:
            wait = max(0.0, until - time.monotonic())
            if not select.select([self._device], [], [], wait)[0]:
                return None
            self._read_block()
        return self._texts.popleft()

    def _read_block(self) -> None:
        data = os.read(self._device.fileno(), _MAX_READ)
        if not data:
            raise CanOperationError("closed by the other end")
        *texts, self._rest = self._end.split(self._rest + data)
        if len(self._rest) > _MAX_TEXT:
            self.malformed += 1
            self._rest = self._rest[-_MAX_TEXT:]
        self._texts.extend(text.decode("ascii", errors="replace") for text in texts)


class SlcanBus(TextBus):
    """Serial CAN adapter that speaks the Lawicel protocol (slcan).

    Parameters
    ----------
    channel : str
        Device file of the serial port.
    bitrate : int
        Bitrate of the CAN bus [bit/s], one of `SLCAN_BITRATES`.
    tty_baudrate : int
        Baud rate of the serial port [bit/s]; USB adapters ignore it.
    write_timeout : float
        Longest wait of a write for free space [s].
    """

    _end = re.compile(rb"(?<=[\r\a])")

    def __init__(
        self, channel: str, *, bitrate: int, tty_baudrate: int, write_timeout: float
    ) -> None:
        self._bitrate_code = SLCAN_BITRATES.index(bitrate)
        try:
            # Locked, because frames of two programs would be mixed.
            device = serial.Serial(channel, tty_baudrate, exclusive=True)
        except serial.SerialException as error:
            if error.errno == errno.EAGAIN:
                raise CanInitializationError("another program uses it") from None
            raise
        super().__init__(device, write_timeout)

    def set_up_channel(self) -> None:
        """Set the bitrate and open the channel."""
        # An earlier program may have left an unfinished line: end it.
        self._write(f"\rC\rS{self._bitrate_code}\rO\r")

    def shutdown(self) -> None:
        """Close the channel and the port."""
        try:
            self._write("C\r")
        finally:
            super().shutdown()

    def _encode(self, message: Message) -> str:
        return f"t{message.arbitration_id:03X}{message.dlc}{message.data.hex().upper()}\r"

    def _decode(self, text: str) -> Message | None:
        if text.endswith("\a"):
            self.refused += 1
            return None
        if len(text) > _MAX_TEXT:
            raise ValueError("no end of a line")
        line = text.strip()
        # Other lines are answers, or frames of other kinds.
        if not line.startswith("t"):
            return None
        data = bytes.fromhex(line[5 : 5 + 2 * int(line[4])])
        return Message(arbitration_id=int(line[1:4], 16), data=data, is_extended_id=False)


class SocketcandBus(TextBus):
    """CAN interface of another machine over TCP: socketcand in raw mode.

    Parameters
    ----------
    channel : str
        Name of the interface on the server.
    host, port : str, int
        Address of the server.
    write_timeout : float
        Longest wait of a frame for free space [s].
    """

    _end = re.compile(rb"(?<=>)")
    _device: socket.socket

    def __init__(self, channel: str, *, host: str, port: int, write_timeout: float) -> None:
        self._channel = channel
        connection = socket.create_connection((host, port), _CONNECT_TIMEOUT)
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        super().__init__(connection, write_timeout)

    def set_up_channel(self) -> None:
        """Open the interface, and receive all its frames."""
        self._expect("< hi >")
        for command in (f"< open {self._channel} >", "< rawmode >"):
            self._write(command)
            self._expect("< ok >")

    def _expect(self, reply: str) -> None:
        text = self._next_text(time.monotonic() + _REPLY_TIMEOUT)
        if text != reply:
            got = "nothing" if text is None else repr(text)
            raise CanInitializationError(f"not a socketcand server: expected {reply!r}, got {got}")

    def _encode(self, message: Message) -> str:
        return convert_can_message_to_ascii_message(message)

    def _decode(self, text: str) -> Message | None:
        # A frame before the last start byte is incomplete.
        message = convert_ascii_message_to_can_message(text[text.rfind("<") :])
        if message is None:
            raise ValueError("not a frame")
        return message

    def _read_block(self) -> None:
        super()._read_block()
        # Acknowledge at once: by default, Linux waits for the next frame that is sent.
        self._device.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
