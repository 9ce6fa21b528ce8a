"""What the executable says where it cannot start."""

from __future__ import annotations

import os
import socket
import sys
from unittest import mock

import pytest

from needle_analysis.ros import openigtlink
from needle_core.process.ros_domain import own_domain


def test_without_pyigtl_it_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert openigtlink.main() == 2
    assert "pyigtl is not installed; docs/slicer.md" in capsys.readouterr().err


def test_a_port_in_use_ends_it_with_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: True)
    with socket.create_server(("127.0.0.1", 0)) as taken, own_domain() as domain:
        port = taken.getsockname()[1]
        words = ["openigtlink", "--ros-args", "-p", f"port:={port}"]
        monkeypatch.setattr(sys, "argv", words)
        with mock.patch.dict(os.environ, ROS_DOMAIN_ID=str(domain)):
            assert openigtlink.main() == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(
        f"error: cannot listen at 127.0.0.1, port {port}: Address already in use"
    )
