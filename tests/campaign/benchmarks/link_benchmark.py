"""openigtlink's server compared with pyigtl's: transforms to one client on loopback."""

from __future__ import annotations

import socket
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial

import numpy as np

from campaign.benchmarks.figure_rows import Row
from needle_bags.link.link_port import LinkPort

_LOOPBACK = "127.0.0.1"
# pyigtl's server keeps this many unsent messages, and drops older ones.
_BURST = 100
_REPETITIONS = 50


def rows() -> Iterator[Row]:
    """Yield the time until one transform, and each of a burst, has arrived at the client."""
    import pyigtl  # noqa: PLC0415 - an extra

    message = pyigtl.TransformMessage(np.eye(4), 1.0, "NeedleTipToRig")
    size = len(message.pack())
    with closing(LinkPort(_LOOPBACK, 0)) as link:
        port = link.port

        def is_connected() -> bool:
            link.exchange(b"")
            return link.listeners.count > 0

        ours = _measured(port, size, is_connected, lambda: link.exchange(message.pack()))
    reference = pyigtl.OpenIGTLinkServer(port)
    try:
        send = partial(reference.send_message, message, wait=False)
        theirs = _measured(port, size, reference.is_connected, send)
    finally:
        reference.stop()
    for what, value, of_pyigtl in zip(
        ("transform", "transform of a burst"), ours, theirs, strict=True
    ):
        key = f"link_{what.replace(' ', '_')}"
        yield Row(key, f"{what} to a client", "ms", value, "pyigtl", of_pyigtl)


def _measured(
    port: int, size: int, is_connected: Callable[[], bool], send: Callable[[], object]
) -> list[float]:
    """Return the median time per transform of `size` bytes, alone and in a burst [ms]."""
    with socket.create_connection((_LOOPBACK, port)) as client:
        while not is_connected():
            time.sleep(0.001)

        def milliseconds(count: int) -> float:
            begin = time.perf_counter()
            for _ in range(count):
                send()
            assert len(client.recv(count * size, socket.MSG_WAITALL)) == count * size
            return 1e3 * (time.perf_counter() - begin) / count

        return [
            statistics.median(milliseconds(count) for _ in range(_REPETITIONS))
            for count in (1, _BURST)
        ]
