"""openigtlink's server beside pyigtl's: transforms to one client on loopback."""

from __future__ import annotations

import socket
import statistics
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial

import numpy as np

from figure_rows import Row
from needle_bags.link.link_port import LinkServer

_LOOPBACK = "127.0.0.1"
_PAIRS = 200
"""Transforms of the latency: each is sent after the one before has arrived."""
_BURST = 5000
# pyigtl's server keeps this many unsent messages, and drops older ones.
_QUEUE = 100
_PAUSE = 2e-4
_TIMEOUT = 30.0


class _Client:
    """Receives whole transforms of one server, with their times of reception [s]."""

    def __init__(self, port: int, size: int) -> None:
        self._connection = socket.create_connection((_LOOPBACK, port), timeout=_TIMEOUT)
        self._size = size
        self.times: list[float] = []
        self._arrived = threading.Condition()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        length = 0
        while part := self._connection.recv(65536):
            length += len(part)
            with self._arrived:
                missing = length // self._size - len(self.times)
                self.times += [time.perf_counter()] * missing
                self._arrived.notify()

    def wait_for(self, count: int) -> None:
        """Wait until `count` transforms have been received."""
        with self._arrived:
            assert self._arrived.wait_for(lambda: len(self.times) >= count, _TIMEOUT)

    def close(self) -> None:
        """End the connection."""
        self._connection.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._connection.close()


def rows() -> Iterator[Row]:
    """Yield the time until a transform has arrived, and the time of one in a burst."""
    import pyigtl  # noqa: PLC0415 - an extra

    message = pyigtl.TransformMessage(np.eye(4), 1.0, "NeedleTipToRig")
    size = len(message.pack())
    with closing(LinkServer(_LOOPBACK, 0)) as server:

        def send() -> None:
            server.send(message.pack(), 0.0)

        def is_connected() -> bool:
            server.poll(0.0)
            return server.clients > 0

        ours = _measured(server.port, size, is_connected, send)
    with socket.create_server((_LOOPBACK, 0)) as free:
        port = free.getsockname()[1]
    reference = pyigtl.OpenIGTLinkServer(port)
    try:
        reply = partial(reference.send_message, message, wait=False)
        theirs = _measured(port, size, reference.is_connected, reply)
    finally:
        reference.stop()
    yield Row("link_latency", "transform to a client, median", "ms", ours[0], "pyigtl", theirs[0])
    yield Row("link_burst", "transform of a burst", "ms", ours[1], "pyigtl", theirs[1])


def _measured(
    port: int, size: int, is_connected: Callable[[], bool], send: Callable[[], object]
) -> tuple[float, float]:
    """Return the median latency, and the time per transform of a burst [ms].

    The transforms have `size` bytes.
    """
    with closing(_Client(port, size)) as client:
        while not is_connected():
            time.sleep(_PAUSE)
        delays = []
        for count in range(_PAIRS):
            begin = time.perf_counter()
            send()
            client.wait_for(count + 1)
            delays.append(client.times[count] - begin)
        begin = time.perf_counter()
        for count in range(_PAIRS, _PAIRS + _BURST):
            while count - len(client.times) >= _QUEUE:
                time.sleep(_PAUSE)
            send()
        client.wait_for(_PAIRS + _BURST)
        return 1e3 * statistics.median(delays), 1e3 * (client.times[-1] - begin) / _BURST
