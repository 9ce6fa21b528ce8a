"""TCP port of openigtlink: sends the same data to all clients and receives their messages.

No client can delay another one or the node: a client that does not read is disconnected when its
socket buffer is full, and may reconnect.
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
"""Maximum number of bytes per read from a client."""


class LinkPort:
    """The real port of `OpenIGTLink`: a non-blocking server.

    Parameters
    ----------
    address : str
        Address to listen on.
    port : int
        Port number; 0 for any free port.

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
        """Number of clients, and the problems of those whose unreadable input is ignored."""
        problems = (stream.problem for stream in self._clients.values() if stream.problem)
        return Listeners(len(self._clients), tuple(problems))

    def open(self, arrive: Callable[[Batch], None]) -> None:
        """Report the address; `arrive` receives all events from now on."""
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
        # accept() raises if no client is waiting; a failed connection delays the rest by one call.
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
    """Return received data; raise an OSError if the client is no longer connected."""
    try:
        data = client.recv(_MAX_READ)
    except BlockingIOError:
        return b""
    if not data:
        raise ConnectionResetError
    return data
