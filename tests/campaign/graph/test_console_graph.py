"""`console --graph`: a page beside ROS nodes, all of which end with it."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request

import pytest

from needle_core.process.ros_domain import own_domain

LIMIT = 60.0


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


def test_a_page_is_served_beside_nodes_until_a_signal_comes() -> None:
    pytest.importorskip("nicegui", reason="the console's lock is not installed: scripts/console")
    port = free_port()
    words = ["--graph", "--level", "tip", "--port", str(port)]
    with own_domain() as domain:
        process = subprocess.Popen(
            [sys.executable, "-m", "needle_bringup.simulation.console", *words],
            env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        try:
            deadline = time.monotonic() + LIMIT
            while "needle" not in page(port).lower():
                assert process.poll() is None
                assert time.monotonic() < deadline
                time.sleep(0.1)
        finally:
            process.send_signal(signal.SIGINT)
            said, _ = process.communicate(timeout=LIMIT)
    assert process.returncode == 130, said
    assert said == f"http://127.0.0.1:{port}/   (Ctrl-C ends all)\n"
