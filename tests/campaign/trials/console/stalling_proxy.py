"""A connection that stalls: what is sent meanwhile comes in a burst."""

from __future__ import annotations

import contextlib
import socket
import threading

_AT_ONCE = 65536


class StallingProxy:
    """Hands on bytes between a port of its own and another one, both ways.

    Parameters
    ----------
    port : int
        Port of this machine to which it leads.
    """

    def __init__(self, port: int) -> None:
        self._to = port
        self._flows = threading.Event()
        self._flows.set()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._sockets: list[socket.socket] = []
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    @property
    def port(self) -> int:
        """Port that leads there."""
        return int(self._listener.getsockname()[1])

    def stall(self) -> None:
        """Let nothing through."""
        self._flows.clear()

    def flow(self) -> None:
        """Let through what has come meanwhile, and all that follows."""
        self._flows.set()

    def close(self) -> None:
        """End all connections."""
        self._flows.set()
        for one in (self._listener, *self._sockets):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        for one in (self._listener, *self._sockets):
            one.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = socket.create_connection(("127.0.0.1", self._to))
                self._sockets += (near, far)
                for ends in ((near, far), (far, near)):
                    ends[1].setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    self._threads.append(threading.Thread(target=self._pass, args=ends))
                    self._threads[-1].start()

    def _pass(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(_AT_ONCE):
                self._flows.wait()
                sink.sendall(data)
        for one in (source, sink):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
