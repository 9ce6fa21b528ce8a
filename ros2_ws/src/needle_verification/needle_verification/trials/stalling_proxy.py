"""A connection that stalls: what is sent meanwhile comes in a burst. It can also be overheard."""

from __future__ import annotations

import collections
import contextlib
import socket
import threading

_AT_ONCE = 65536
# Request and token, and what came last.
_FIRST, _LAST = 2, 30


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
        self._replay: socket.socket | None = None
        self._first: list[bytes] = []
        self._last: collections.deque[bytes] = collections.deque(maxlen=_LAST)
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

    def replay(self) -> None:
        """Say on a new connection what the last one began with, and what came on it last."""
        if self._replay is not None:
            self._replay.close()
        self._replay = socket.create_connection(("127.0.0.1", self._to))
        with contextlib.suppress(OSError):
            self._replay.sendall(b"".join((*self._first, *self._last)))

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
        if self._replay is not None:
            self._replay.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = socket.create_connection(("127.0.0.1", self._to))
                self._sockets += (near, far)
                self._first.clear()
                self._last.clear()
                for source, sink, heard in ((near, far, True), (far, near, False)):
                    sink.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    ends = (source, sink, heard)
                    self._threads.append(threading.Thread(target=self._pass, args=ends))
                    self._threads[-1].start()

    def _pass(self, source: socket.socket, sink: socket.socket, heard: bool) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(_AT_ONCE):
                if heard and len(self._first) < _FIRST:
                    self._first.append(data)
                elif heard:
                    self._last.append(data)
                self._flows.wait()
                sink.sendall(data)
        for one in (source, sink):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
