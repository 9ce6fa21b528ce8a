"""`console --graph`: a page beside ROS nodes, all of which end with it."""

from __future__ import annotations

import signal
import socket
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from campaign.checking import Workbench


def free_port() -> int:
    """Return a port that is free, and the next one, too."""
    with socket.socket() as one, socket.socket() as next_one:
        one.bind(("127.0.0.1", 0))
        port = int(one.getsockname()[1])
        next_one.bind(("127.0.0.1", port + 1))
        return port


def page(port: int) -> str:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=5.0) as answer:
            return str(answer.read().decode())
    except (urllib.error.URLError, ConnectionError):
        return ""


def test_a_page_is_served_beside_nodes_until_a_signal_comes(tmp_path: Path) -> None:
    pytest.importorskip("nicegui", reason="the console's lock is not installed: scripts/console")
    port = free_port()
    command = [sys.executable, "-m", "needle_bringup.simulation.console", "--graph"]
    started = Workbench(command, tmp_path).start("bag", "--level", "tip", "--port", str(port))
    deadline = time.monotonic() + 60.0
    while "needle" not in page(port).lower():
        assert started.process.poll() is None and time.monotonic() < deadline
        time.sleep(0.1)
    started.interrupt(signal.SIGINT)
    ended = started.wait(60.0)
    assert (ended.code, ended.left_over) == (130, [])
