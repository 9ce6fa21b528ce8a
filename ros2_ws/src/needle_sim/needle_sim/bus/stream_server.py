"""TCP server for a byte stream: the port of emulated drives with a text protocol."""

from __future__ import annotations

import contextlib
import itertools
import socket
import threading
from collections.abc import Callable, Sequence
from socketserver import ThreadingTCPServer
from typing import Any

from needle_core.errors import UserError

_HOST = "127.0.0.1"
_READ_SIZE = 4096
_WAKE_UP_PERIOD = 0.05  # [s]


class ClientBytes(bytes):
    """Bytes from or for one client.

    Plain bytes belong to client 0, the only one of a connection between components.

    Parameters
    ----------
    data : bytes
        The bytes.
    client : int
        Number of the client.
    """

    client: int

    def __new__(cls, data: bytes, client: int) -> ClientBytes:
        """Return the bytes, marked with their client."""
        made = super().__new__(cls, data)
        made.client = client
        return made


class _Server(ThreadingTCPServer):
    allow_reuse_address = daemon_threads = True


class StreamServer:
    """Port of a component: bytes from and for any number of clients, each with a reader thread.

    Parameters
    ----------
    port : int
        TCP port on this computer.

    Raises
    ------
    UserError
        If the port is in use.
    """

    def __init__(self, port: int) -> None:
        self._address = (_HOST, port)
        self._numbers = itertools.count()
        self._clients: dict[int, socket.socket] = {}
        self._server: _Server | None = None
        self._arrive: Callable[[Any], None] = lambda _: None
        self.plug(plugged_in=True)

    @property
    def path(self) -> str:
        """Host and port, in the form that a client uses."""
        return "{}:{}".format(*self._address)

    def open(self, arrive: Callable[[Any], None]) -> None:
        """Start delivering the clients' bytes."""
        self._arrive = arrive

    def send(self, batch: Sequence[bytes]) -> None:
        """Send bytes to their client, or to all; drop a client that does not read."""
        for data in batch:
            for number, client in list(self._clients.items()):
                if getattr(data, "client", number) == number:
                    try:
                        is_full = client.send(data, socket.MSG_DONTWAIT) < len(data)
                    except OSError:
                        is_full = True
                    if is_full:
                        _drop(client)

    def plug(self, *, plugged_in: bool) -> None:
        """Listen, or close all connections and stop listening."""
        if plugged_in and self._server is None:
            serve: Any = lambda client, *_: self._serve(client)  # noqa: E731
            try:
                self._server = _Server(self._address, serve)
            except OSError as error:
                raise UserError(f"cannot listen at {self.path}: {error.strerror}") from error
            serve_forever = self._server.serve_forever
            threading.Thread(target=serve_forever, args=(_WAKE_UP_PERIOD,), daemon=True).start()
        elif not plugged_in and self._server is not None:
            self._server.shutdown()
            self._server.server_close()
            self._server = None
            for client in list(self._clients.values()):
                _drop(client)

    def close(self) -> None:
        """Close all connections."""
        self.plug(plugged_in=False)

    def _serve(self, client: socket.socket) -> None:
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        number = next(self._numbers)
        self._clients[number] = client
        with contextlib.suppress(OSError):
            while data := client.recv(_READ_SIZE):
                self._arrive((ClientBytes(data, number),))
        del self._clients[number]


def _drop(client: socket.socket) -> None:
    """End the connection; its thread ends with it."""
    with contextlib.suppress(OSError):
        client.shutdown(socket.SHUT_RDWR)
