"""The real port of tracked_tip against pyigtl's server and client in the role of PLUS."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from needle_core.component import PortChange
from needle_core.openigtlink import LinkMessage, LinkStream
from needle_tracker.ros.tracked_tip import TransformPort

pyigtl = pytest.importorskip("pyigtl", reason="the lock is not installed: docs/viewers.md")
LIMIT = 20.0
STAMP = 1_700_000_000.25


@contextlib.contextmanager
def opened(port: TransformPort) -> Iterator[list[Any]]:
    arrived: list[Any] = []
    port.open(arrived.append)
    try:
        yield arrived
    finally:
        port.close()


def transform_of(arrived: list[Any], sender: Any) -> LinkMessage:
    """Send a transform from a pyigtl server or client until the port receives it; return it."""
    stream, deadline = LinkStream("TRANSFORM"), time.monotonic() + LIMIT
    pose, read = np.diag([1.0, -1.0, -1.0, 1.0]), 0
    while True:
        assert time.monotonic() < deadline
        sender.send_message(pyigtl.TransformMessage(pose, STAMP, "NeedleToTracker"), wait=False)
        time.sleep(0.01)
        for batch in arrived[read:]:
            for found in stream.split(batch[0]) if isinstance(batch, tuple) else ():
                return found
        read = len(arrived)


def test_client_side_receives_from_pyigtls_server_and_reports_its_end() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        number = free.getsockname()[1]
    with opened(TransformPort(f"127.0.0.1:{number}", listens=False)) as arrived:
        while not arrived:
            time.sleep(0.01)
        assert "refused" in arrived[0].lost
        server = pyigtl.OpenIGTLinkServer(port=number)
        assert transform_of(arrived, server).name == "NeedleToTracker"
        server.stop()
        deadline = time.monotonic() + LIMIT
        while not (isinstance(arrived[-1], PortChange) and arrived[-1].lost):
            assert time.monotonic() < deadline
            time.sleep(0.01)


def test_server_side_receives_from_pyigtls_client() -> None:
    port = TransformPort("127.0.0.1:0", listens=True)
    with opened(port) as arrived:
        client = pyigtl.OpenIGTLinkClient(*port.address)
        found = transform_of(arrived, client)
        client.stop()
    np.testing.assert_array_equal(found.transform()[0], np.diag([1.0, -1.0, -1.0, 1.0]))
