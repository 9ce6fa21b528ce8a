"""TCP connection to a tracker's OpenIGTLink server, or server for its client: bytes in."""

from __future__ import annotations

import socket

from needle_core.errors import UserError
from needle_core.ports.byte_port import BytePort, TcpStream

_WAKE_UP_PERIOD, _CONNECT_TIMEOUT = 0.2, 1.0  # [s]


class TransformPort(BytePort):
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
        super().__init__()
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

    def close(self) -> None:
        """Disconnect."""
        super().close()
        if self._server is not None:
            self._server.close()

    def _open_device(self) -> TcpStream:
        if self._server is not None:
            return TcpStream(self._server.accept()[0], _WAKE_UP_PERIOD)
        connection = socket.create_connection(self.address, timeout=_CONNECT_TIMEOUT)
        return TcpStream(connection, _WAKE_UP_PERIOD)
