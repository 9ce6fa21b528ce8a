"""CAN interface of another machine over TCP: socketcand in raw mode."""

from __future__ import annotations

import select
import socket
import time
from collections import deque

from can import BusABC, CanInitializationError, CanOperationError, Message
from can.interfaces.socketcand.socketcand import (
    convert_ascii_message_to_can_message,
    convert_can_message_to_ascii_message,
)

# Longest time to connect, and for each reply of the server [s].
_CONNECT_TIMEOUT = 1.0
_REPLY_TIMEOUT = 1.0
_MAX_MESSAGE = 200


class SocketcandBus(BusABC):
    """Client of the socketcand protocol that never blocks; python-can converts the frames.

    python-can's own client waits for a silent server without a time-out, rejects a frame that
    arrives together with a reply, and does not detect that the server closed the connection.

    Parameters
    ----------
    channel : str
        Name of the interface on the server.
    host, port : str, int
        Address of the server.
    write_timeout : float
        Longest wait of a frame for free space [s].

    Attributes
    ----------
    malformed : int
        Number of malformed messages.
    """

    def __init__(self, channel: str, *, host: str, port: int, write_timeout: float) -> None:
        self.malformed = 0
        self._write_timeout = write_timeout
        self._buffer = b""
        self._messages: deque[str] = deque()
        self._socket = socket.create_connection((host, port), _CONNECT_TIMEOUT)
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._expect("< hi >")
            for command in (f"< open {channel} >", "< rawmode >"):
                self._write(command)
                self._expect("< ok >")
        except BaseException:
            self._socket.close()
            raise
        self._socket.settimeout(write_timeout)
        self.channel_info = f"socketcand {host}:{port} {channel}"
        super().__init__(channel=channel)

    def send(self, msg: Message, timeout: float | None = None) -> None:
        """Send a frame; `timeout` is ignored in favour of the write time-out of the bus."""
        del timeout
        self._write(convert_can_message_to_ascii_message(msg))

    def shutdown(self) -> None:
        """Close the connection."""
        super().shutdown()
        self._socket.close()

    def fileno(self) -> int:
        """Return the file descriptor of the connection."""
        return self._socket.fileno()

    def _recv_internal(self, timeout: float | None) -> tuple[Message | None, bool]:
        text = self._read_message(timeout)
        if text is None:
            return None, False
        try:
            message = convert_ascii_message_to_can_message(text)
        except (ValueError, IndexError):
            message = None
        self.malformed += message is None
        return message, False

    def _write(self, message: str) -> None:
        try:
            self._socket.sendall(message.encode("ascii"))
        except TimeoutError:
            raise CanOperationError(f"accepted no data for {self._write_timeout:g} s") from None

    def _expect(self, reply: str) -> None:
        received = self._read_message(_REPLY_TIMEOUT)
        if received != reply:
            got = "nothing" if received is None else repr(received)
            raise CanInitializationError(f"not a socketcand server: expected {reply!r}, got {got}")

    def _read_message(self, timeout: float | None) -> str | None:
        """Return the next message, from < to >; None if none arrives in time."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while not self._messages:
            wait = None if deadline is None else max(0.0, deadline - time.monotonic())
            if not select.select([self._socket], [], [], wait)[0]:
                return None
            self._read_block()
        return self._messages.popleft()

    def _read_block(self) -> None:
        data = self._socket.recv(4096)
        if not data:
            raise CanOperationError("the server closed the connection")
        # Acknowledge at once: by default, Linux waits for the next frame that is sent.
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        *complete, self._buffer = (self._buffer + data).split(b">")
        for message in complete:
            start = message.rfind(b"<", -_MAX_MESSAGE)
            if start >= 0:
                self._messages.append(message[start:].decode("ascii", errors="replace") + ">")
            else:
                self.malformed += 1
        if len(self._buffer) > _MAX_MESSAGE:
            self.malformed += 1
            self._buffer = self._buffer[-_MAX_MESSAGE:]
