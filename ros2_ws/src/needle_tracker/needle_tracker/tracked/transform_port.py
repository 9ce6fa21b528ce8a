"""TCP connection to a tracker's OpenIGTLink server, or server for its client: bytes in."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable

from needle_core.component import Batch, PortChange
from needle_core.errors import UserError

_WAKE_UP_PERIOD, _CONNECT_TIMEOUT = 0.2, 1.0  # [s]
_CHUNK = 65536


class TransformPort:
    """Receives bytes from one peer at a time, and reconnects after a loss.

    Parameters
    ----------
    address : str
        HOST:PORT to connect to, or to listen on.
    listens : bool
        Whether the tracker's software connects to this computer.

    Attributes
    ----------
    address : tuple
        Host and port.

    Raises
    ------
    UserError
        An address that is not HOST:PORT, or not available to listen on.
    """

    def __init__(self, address: str, *, listens: bool) -> None:
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._server: socket.socket | None = None
        host, _, port = address.rpartition(":")
        try:
            self.address = (host, int(port))
            if listens:
                self._server = socket.create_server(self.address)
                self._server.settimeout(_WAKE_UP_PERIOD)
                self.address = self._server.getsockname()
        except (OSError, ValueError, OverflowError) as error:
            raise UserError(f"address = {address!r}: {error}") from error

    def open(self, arrive: Callable[[Batch | PortChange], None]) -> None:
        """Start; `arrive` receives chunks of bytes."""
        self._arrive = arrive
        self._thread.start()

    def send(self, batch: tuple[bytes, ...]) -> None:
        """Do nothing: the tracker receives nothing."""

    def close(self) -> None:
        """Disconnect."""
        self._closed.set()
        self._thread.join()
        if self._server is not None:
            self._server.close()

    def _run(self) -> None:
        while not self._closed.is_set():
            reason = "closed by the tracker"
            try:
                with self._connect() as connection:
                    self._arrive(PortChange())
                    self._receive(connection)
            except OSError as error:
                reason = str(error)
            self._arrive(PortChange(f"no connection: {reason}"))
            self._closed.wait(_WAKE_UP_PERIOD)

    def _connect(self) -> socket.socket:
        if self._server is not None:
            return self._server.accept()[0]
        return socket.create_connection(self.address, timeout=_CONNECT_TIMEOUT)

    def _receive(self, connection: socket.socket) -> None:
        connection.settimeout(_WAKE_UP_PERIOD)
        while not self._closed.is_set():
            with contextlib.suppress(TimeoutError):
                data = connection.recv(_CHUNK)
                if not data:
                    return
                self._arrive((data,))
