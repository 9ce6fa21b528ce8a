"""TCP server of a byte stream: the port of emulated drives that speak lines of text."""

from __future__ import annotations

import contextlib
import itertools
import select
import socket
import threading
from collections.abc import Callable, Sequence
from typing import Any

from needle_core.errors import UserError
from needle_sim.bus.client_bytes import ClientBytes

_HOST = "127.0.0.1"
_READ_SIZE = 4096
_WAKE_UP_PERIOD = 0.05  # [s]


class StreamServer:
    """Port of a component: bytes from and for any number of clients, with a reader thread.

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
        self._listener: socket.socket | None = None
        self._lock = threading.Lock()
        self._is_closed = False
        self._thread: threading.Thread | None = None
        self.plug(plugged_in=True)

    @property
    def path(self) -> str:
        """Host and port, as a client gives them."""
        return "{}:{}".format(*self._address)

    def open(self, arrive: Callable[[Any], None]) -> None:
        """Start the reader thread."""
        self._thread = threading.Thread(target=self._read, args=(arrive,), daemon=True)
        self._thread.start()

    def send(self, batch: Sequence[bytes]) -> None:
        """Send bytes to their client, or to all; drop a client that does not read."""
        with self._lock:
            for data in batch:
                number = getattr(data, "client", None)
                for client in list(self._clients) if number is None else (number,):
                    self._send(client, data)

    def plug(self, *, plugged_in: bool) -> None:
        """Listen, or close all connections and stop listening."""
        with self._lock:
            if plugged_in and self._listener is None:
                try:
                    self._listener = socket.create_server(self._address)
                except OSError as error:
                    raise UserError(f"cannot listen at {self.path}: {error.strerror}") from error
            elif not plugged_in and self._listener is not None:
                for client in list(self._clients):
                    self._drop(client)
                self._listener.close()
                self._listener = None

    def close(self) -> None:
        """Stop the reader thread and close all connections."""
        self._is_closed = True
        if self._thread is not None:
            self._thread.join()
        self.plug(plugged_in=False)

    def _read(self, arrive: Callable[[Any], None]) -> None:
        while not self._is_closed:
            with self._lock:
                sockets = [*self._clients.values(), *([self._listener] if self._listener else ())]
            try:
                select.select(sockets, [], [], _WAKE_UP_PERIOD)
            except (OSError, ValueError):
                # A socket was closed meanwhile.
                continue
            with self._lock:
                chunks = self._receive()
            if chunks:
                arrive(chunks)

    def _receive(self) -> tuple[ClientBytes, ...]:
        """Accept new clients; return the bytes of all; never block."""
        if self._listener is not None and select.select([self._listener], [], [], 0.0)[0]:
            with contextlib.suppress(OSError):
                client, _ = self._listener.accept()
                client.setblocking(False)
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._clients[next(self._numbers)] = client
        chunks = []
        for number, client in list(self._clients.items()):
            try:
                data = client.recv(_READ_SIZE)
            except BlockingIOError:
                continue
            except OSError:
                data = b""
            if data:
                chunks.append(ClientBytes(data, number))
            else:
                self._drop(number)
        return tuple(chunks)

    def _send(self, number: int, data: bytes) -> None:
        if client := self._clients.get(number):
            try:
                client.sendall(data)
            except OSError:
                self._drop(number)

    def _drop(self, number: int) -> None:
        self._clients.pop(number).close()
