"""TCP port of openigtlink: sends the same data to all clients and receives their messages.

No client delays another or the node: one that does not read is disconnected as soon as the
system's buffer of its connection is full, and may connect again.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable

from needle_bags.link.openigtlink import Listeners
from needle_core.component import Batch, Log
from needle_core.errors import UserError
from needle_core.openigtlink import LinkMessage, LinkStream

_MAX_READ = 65536
"""Bytes that are read from a client at a time."""


class LinkPort:
    """The real port of `OpenIGTLink`: a non-blocking server.

    Parameters
    ----------
    address : str
        Address to listen on.
    port : int
        0: any free port.

    Raises
    ------
    UserError
        If the address is not available.
    """

    def __init__(self, address: str, port: int) -> None:
        try:
            family = socket.AF_INET6 if ":" in address else socket.AF_INET
            self._server = socket.create_server((address, port), family=family)
        except OSError as error:
            raise UserError(f"cannot listen at {address}, port {port}: {error.strerror}") from error
        self._server.setblocking(False)
        self._clients: dict[socket.socket, LinkStream] = {}

    @property
    def port(self) -> int:
        """Number of the port."""
        return int(self._server.getsockname()[1])

    @property
    def listeners(self) -> Listeners:
        """Clients, and the problem of each whose input is no OpenIGTLink and therefore ignored."""
        problems = (stream.problem for stream in self._clients.values() if stream.problem)
        return Listeners(len(self._clients), tuple(problems))

    def open(self, arrive: Callable[[Batch], None]) -> None:
        """Begin; `arrive` receives the events."""
        self._arrive = arrive
        address = self._server.getsockname()[0]
        arrive((Log("info", f"shows the needle at {address}, port {self.port}"),))

    def send(self, batch: tuple[bytes, ...]) -> None:
        """Send whole messages without blocking, and report clients and their messages."""
        messages = self.exchange(b"".join(batch))
        self._arrive((self.listeners, *messages))

    def exchange(self, data: bytes) -> list[LinkMessage]:
        """Accept clients, receive, send whole messages, and disconnect clients that do not read.

        Returns
        -------
        list of LinkMessage
            The received messages.
        """
        # Ends when no client waits; one that is already gone delays the others by a round.
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._server.accept()
                client.setblocking(False)
                self._clients[client] = LinkStream()
        messages: list[LinkMessage] = []
        for client, stream in tuple(self._clients.items()):
            try:
                messages += stream.split(_received(client))
                if data and client.send(data) < len(data):
                    raise BlockingIOError
            except OSError:
                client.close()
                del self._clients[client]
        return messages

    def close(self) -> None:
        """Disconnect all clients and close the port."""
        for each in (*self._clients, self._server):
            each.close()


def _received(client: socket.socket) -> bytes:
    """Return received data; raises OSError if the client is no longer connected."""
    try:
        data = client.recv(_MAX_READ)
    except BlockingIOError:
        return b""
    if not data:
        raise ConnectionResetError
    return data
