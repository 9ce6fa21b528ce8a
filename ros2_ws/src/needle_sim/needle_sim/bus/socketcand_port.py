"""A TCP server that speaks socketcand's raw mode, for one client on this machine."""

from __future__ import annotations

import contextlib
import re
import socket
import time

from needle_common.errors import UserError
from needle_sim.bus.can_frame import CanFrame

_READ_SIZE = 4096
_MOST_DATA = 8
_MESSAGE = re.compile(rb"<\s*([^<>]*?)\s*>")
_LONGEST = 200


class SocketcandPort:
    """The bus as socketcand serves it: `< send ID LENGTH BYTES >`, `< frame ID TIME BYTES >`.

    Parameters
    ----------
    port : int
        TCP port on localhost; 0 takes any free one.

    Raises
    ------
    UserError
        If the port is taken.
    """

    def __init__(self, port: int) -> None:
        self.port = port
        self._server: socket.socket | None = None
        self._client: socket.socket | None = None
        self._buffer = b""
        self._raw = False
        self.plug_in()

    @property
    def filenos(self) -> list[int]:
        """File descriptors to wait for input at; none while unplugged."""
        return [s.fileno() for s in (self._server, self._client) if s is not None]

    def plug_in(self) -> None:
        """Listen."""
        if self._server is not None:
            return
        try:
            self._server = socket.create_server(("127.0.0.1", self.port))
        except OSError as error:
            raise UserError(f"socketcand_port {self.port}: {error.strerror}") from error
        self.port = self._server.getsockname()[1]
        self._server.setblocking(False)

    def unplug(self) -> None:
        """Disappear: the client's connection ends."""
        self._drop_client()
        if self._server is not None:
            self._server.close()
            self._server = None

    def receive(self) -> tuple[CanFrame, ...]:
        """Return the frames that the client has sent; waits for nothing."""
        self._accept()
        if self._client is None:
            return ()
        try:
            data = self._client.recv(_READ_SIZE)
        except BlockingIOError:
            return ()
        except OSError:
            data = b""
        if not data:
            self._drop_client()
            return ()
        self._buffer += data
        frames: list[CanFrame] = []
        end = 0
        for message in _MESSAGE.finditer(self._buffer):
            end = message.end()
            self._take(message[1].split(), frames)
        self._buffer = self._buffer[end:][-_LONGEST:]
        return tuple(frames)

    def send(self, frames: list[CanFrame]) -> None:
        """Hand frames from the bus to the client."""
        if self._raw:
            for frame in frames:
                self._say(
                    f"< frame {frame.identifier:03X} {time.time():.6f} {frame.data.hex().upper()} >"
                )

    def _accept(self) -> None:
        if self._server is None:
            return
        with contextlib.suppress(BlockingIOError):
            client, _ = self._server.accept()
            self._drop_client()
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._client = client
            self._say("< hi >")

    def _take(self, words: list[bytes], frames: list[CanFrame]) -> None:
        if words[:1] in ([b"open"], [b"rawmode"]):
            self._raw = words[0] == b"rawmode"
            self._say("< ok >")
        elif words[:1] == [b"send"] and self._raw:
            try:
                identifier, length = int(words[1], 16), int(words[2], 16)
                data = bytes(int(word, 16) for word in words[3:])
            except (IndexError, ValueError):
                self._say("< error could not parse the frame >")
                return
            if length == len(data) <= _MOST_DATA and identifier <= 0x7FF and len(words[1]) == 3:
                frames.append(CanFrame(identifier, data))
        else:
            self._say("< error unknown command >")

    def _say(self, text: str) -> None:
        if self._client is None:
            return
        try:
            self._client.sendall(text.encode("ascii"))
        except OSError:
            self._drop_client()

    def _drop_client(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None
        self._buffer = b""
        self._raw = False
