"""A CAN interface of another machine, over TCP: socketcand in its raw mode."""

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

# How long the server may take to be there, and to each of its answers [s].
_CONNECT_WAIT = 1.0
_ANSWER_WAIT = 1.0
_LONGEST_MESSAGE = 200


class SocketcandBus(BusABC):
    """socketcand's protocol with python-can's own words for frames.

    python-can's bus waits for a server that says nothing for ever, takes no frame together with
    the answer to its last order, and does not notice that the server hung up.

    Parameters
    ----------
    channel : str
        The server's name of the interface.
    host : str
        Where the server runs.
    port : int
        Where it listens.
    write_timeout : float
        How long a frame may wait for room [s].
    """

    def __init__(self, channel: str, *, host: str, port: int, write_timeout: float) -> None:
        self.malformed = 0
        self._write_timeout = write_timeout
        self._piece = b""
        self._too_long = False
        self._said: deque[str] = deque()
        self._socket = socket.create_connection((host, port), _CONNECT_WAIT)
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._expect("< hi >")
            for order in (f"< open {channel} >", "< rawmode >"):
                self._tell(order)
                self._expect("< ok >")
        except BaseException:
            self._socket.close()
            raise
        self._socket.settimeout(write_timeout)
        self.channel_info = f"socketcand {host}:{port} {channel}"
        super().__init__(channel=channel)

    def send(self, msg: Message, timeout: float | None = None) -> None:
        """Send a frame; how long that may take is the bus's own."""
        del timeout
        self._tell(convert_can_message_to_ascii_message(msg))

    def shutdown(self) -> None:
        """Hang up."""
        super().shutdown()
        self._socket.close()

    def fileno(self) -> int:
        """Return the connection's file descriptor."""
        return self._socket.fileno()

    def _recv_internal(self, timeout: float | None) -> tuple[Message | None, bool]:
        said = self._hear(timeout)
        if said is None:
            return None, False
        try:
            message = convert_ascii_message_to_can_message(said)
        except (ValueError, IndexError):
            message = None
        self.malformed += message is None
        return message, False

    def _tell(self, words: str) -> None:
        try:
            self._socket.sendall(words.encode("ascii"))
        except TimeoutError:
            raise CanOperationError(f"takes nothing for {self._write_timeout:g} s") from None

    def _expect(self, answer: str) -> None:
        said = self._hear(_ANSWER_WAIT)
        if said != answer:
            got = "nothing" if said is None else repr(said)
            raise CanInitializationError(f"no socketcand: wanted {answer!r}, got {got}")

    def _hear(self, timeout: float | None) -> str | None:
        """Return the next message, from < to >; None if none comes in time."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while not self._said:
            wait = None if deadline is None else max(0.0, deadline - time.monotonic())
            if not select.select([self._socket], [], [], wait)[0]:
                return None
            self._read()
        return self._said.popleft()

    def _read(self) -> None:
        data = self._socket.recv(4096)
        if not data:
            raise CanOperationError("the server hung up")
        # An answer at once, not with the next frame.
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        *whole, piece = (self._piece + data).split(b">")
        for message in whole:
            too_long = self._is_too_long(message)
            self._too_long = False
            start = message.rfind(b"<", -_LONGEST_MESSAGE)
            if start >= 0:
                self._said.append(message[start:].decode("ascii", errors="replace") + ">")
            else:
                self.malformed += not too_long
        self._too_long = self._is_too_long(piece)
        self._piece = piece[-_LONGEST_MESSAGE:]

    def _is_too_long(self, message: bytes) -> bool:
        """Count what does not end, once: in whatever pieces it comes, it is one error."""
        if self._too_long or len(message) <= _LONGEST_MESSAGE:
            return self._too_long
        self.malformed += 1
        return True
