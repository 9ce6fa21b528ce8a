"""A port that says the same to all who listen, and takes no word from them.

What comes in is read and thrown away, so that nothing that anybody sends can do harm. Nothing waits
for a listener: one that is slow misses a round, one that has stopped reading is let go.
"""

from __future__ import annotations

import dataclasses
import socket

from needle_core.errors import UserError

MOST_LISTENERS = 8
STALLED = 5.0
"""How long a listener may leave a round unread [s]."""
_THROWN_AWAY = 65536
"""Most that is read of a listener in a turn [bytes]."""


@dataclasses.dataclass
class _Listener:
    connection: socket.socket
    unsent: bytes = b""
    since: float = 0.0


class LinkServer:
    """The port.

    Parameters
    ----------
    address : str
        Where it listens.
    port : int
        0: any that is free.

    Raises
    ------
    UserError
        If it cannot listen there.
    """

    def __init__(self, address: str, port: int) -> None:
        try:
            family = socket.AF_INET6 if ":" in address else socket.AF_INET
            self._server = socket.create_server((address, port), family=family)
        except OSError as error:
            raise UserError(f"cannot listen at {address}, port {port}: {error.strerror}") from error
        self._server.setblocking(False)
        self._listeners: list[_Listener] = []
        self.turned_away = 0

    @property
    def port(self) -> int:
        """Port that is listened on."""
        return int(self._server.getsockname()[1])

    @property
    def listeners(self) -> int:
        """Number of clients that are connected."""
        return len(self._listeners)

    def turn(self, now: float) -> None:
        """Accept clients, read, send, and drop those that have gone or stopped reading.

        Parameters
        ----------
        now : float
            Steady time [s].
        """
        self._accept()
        for listener in tuple(self._listeners):
            if not (self._is_there(listener) and self._send_on(listener, now)):
                self._let_go(listener)

    def say(self, data: bytes, now: float) -> None:
        """Say something to all who have read what was said before.

        Parameters
        ----------
        data : bytes
            Whole messages.
        now : float
            Steady time [s].
        """
        for listener in tuple(self._listeners):
            if not listener.unsent:
                listener.unsent, listener.since = data, now
                if not self._send_on(listener, now):
                    self._let_go(listener)

    def close(self) -> None:
        """Let all go."""
        for listener in tuple(self._listeners):
            self._let_go(listener)
        self._server.close()

    def _accept(self) -> None:
        for _ in range(MOST_LISTENERS):
            try:
                connection, _ = self._server.accept()
            except BlockingIOError:
                return
            except OSError:
                # It has gone again.
                continue
            if len(self._listeners) == MOST_LISTENERS:
                self.turned_away += 1
                connection.close()
                continue
            connection.setblocking(False)
            self._listeners.append(_Listener(connection))

    @staticmethod
    def _is_there(listener: _Listener) -> bool:
        try:
            return bool(listener.connection.recv(_THROWN_AWAY))
        except BlockingIOError:
            return True
        except OSError:
            return False

    @staticmethod
    def _send_on(listener: _Listener, now: float) -> bool:
        """Send what can be sent; return whether there is still somebody who reads."""
        sent = 0
        try:
            if listener.unsent:
                sent = listener.connection.send(listener.unsent)
        except BlockingIOError:
            pass
        except OSError:
            return False
        listener.unsent = listener.unsent[sent:]
        return not listener.unsent or now - listener.since <= STALLED

    def _let_go(self, listener: _Listener) -> None:
        self._listeners.remove(listener)
        listener.connection.close()
