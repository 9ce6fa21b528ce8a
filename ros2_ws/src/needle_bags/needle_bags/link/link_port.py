"""TCP port of openigtlink: sends the same data to all clients and receives their messages.

No client delays another or the node: a slow client misses rounds, and a client that has stopped
reading is disconnected.
"""

from __future__ import annotations

import dataclasses
import socket
import time
from collections.abc import Callable

from needle_bags.link.openigtlink import Listeners, OpenIGTLinkParameters
from needle_core.component import Batch, Log
from needle_core.errors import UserError
from needle_core.openigtlink import LinkMessage, LinkStream

MAX_CLIENTS = 8
STALL_TIMEOUT = 5.0
"""Time after which a client that does not read is disconnected [s]."""
_MAX_READ = 65536
"""Bytes that are read from a client at a time."""


@dataclasses.dataclass
class _Client:
    connection: socket.socket
    input: LinkStream = dataclasses.field(default_factory=LinkStream)
    unsent: bytes = b""
    since: float = 0.0


class LinkServer:
    """Non-blocking server of the port.

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
        self._clients: list[_Client] = []
        self._turned_away = 0

    @property
    def port(self) -> int:
        """Number of the port."""
        return int(self._server.getsockname()[1])

    @property
    def listeners(self) -> Listeners:
        """Clients, and the problem of each whose input is no OpenIGTLink and therefore ignored."""
        problems = (client.input.problem for client in self._clients if client.input.problem)
        return Listeners(len(self._clients), self._turned_away, tuple(problems))

    def poll(self, now: float) -> list[LinkMessage]:
        """Accept clients, read and send, and disconnect clients that are gone or stalled.

        Parameters
        ----------
        now : float
            Steady time [s].

        Returns
        -------
        list of LinkMessage
            The received messages.
        """
        self._accept()
        messages: list[LinkMessage] = []
        for client in tuple(self._clients):
            data = self._read(client)
            messages += client.input.split(data or b"")
            if data is None or not self._send_rest(client, now):
                self._disconnect(client)
        return messages

    def send(self, data: bytes, now: float) -> None:
        """Send whole messages to all clients that have read the previous ones.

        Parameters
        ----------
        data : bytes
            The messages.
        now : float
            Steady time [s].
        """
        for client in tuple(self._clients):
            if not client.unsent:
                client.unsent, client.since = data, now
                if not self._send_rest(client, now):
                    self._disconnect(client)

    def close(self) -> None:
        """Disconnect all clients and close the port."""
        for client in tuple(self._clients):
            self._disconnect(client)
        self._server.close()

    def _accept(self) -> None:
        for _ in range(MAX_CLIENTS):
            try:
                connection, _ = self._server.accept()
            except BlockingIOError:
                return
            except OSError:
                continue  # already disconnected
            if len(self._clients) == MAX_CLIENTS:
                self._turned_away += 1
                connection.close()
                continue
            connection.setblocking(False)
            self._clients.append(_Client(connection))

    @staticmethod
    def _read(client: _Client) -> bytes | None:
        """Return received data; None if the client is no longer connected."""
        try:
            return client.connection.recv(_MAX_READ) or None
        except BlockingIOError:
            return b""
        except OSError:
            return None

    @staticmethod
    def _send_rest(client: _Client, now: float) -> bool:
        """Send as much as possible; return whether the client is still connected and reading."""
        sent = 0
        try:
            if client.unsent:
                sent = client.connection.send(client.unsent)
        except BlockingIOError:
            pass
        except OSError:
            return False
        client.unsent = client.unsent[sent:]
        return not client.unsent or now - client.since <= STALL_TIMEOUT

    def _disconnect(self, client: _Client) -> None:
        self._clients.remove(client)
        client.connection.close()


class LinkPort:
    """The real port of `OpenIGTLink`: sends data to all clients and reports their number.

    Parameters
    ----------
    settings : OpenIGTLinkParameters
        Address and port.

    Attributes
    ----------
    server : LinkServer
        The server.

    Raises
    ------
    UserError
        If the address is not available.
    """

    def __init__(self, settings: OpenIGTLinkParameters) -> None:
        self.server = LinkServer(settings.address, settings.port)
        self._place = f"{settings.address}, port {self.server.port}"

    def open(self, arrive: Callable[[Batch], None]) -> None:
        """Begin; `arrive` receives the events."""
        self._arrive = arrive
        arrive((Log("info", f"shows the needle at {self._place}"),))

    def send(self, batch: tuple[bytes, ...]) -> None:
        """Send whole messages without blocking."""
        now = time.monotonic()
        messages = self.server.poll(now)
        for data in batch:
            self.server.send(data, now)
        self._arrive((self.server.listeners, *messages))

    def close(self) -> None:
        """Disconnect all clients."""
        self.server.close()
