"""Stream port on TCP and on a pseudo-terminal, and the link that splits its bytes into lines.

The port's thread is not started: each test calls its steps.
"""

from __future__ import annotations

import os
import socket
import tty
from collections.abc import Iterator
from typing import Any

import pytest

from needle_core.component import PortChange
from needle_core.ports import reopening_port
from needle_device_driver.axes.link import LinkError
from needle_device_driver.polled.text_link import StreamPort, TextLink


class Port:
    """A port that records bytes and changes."""

    def __init__(self, address: str) -> None:
        self.data, self.changes = b"", list[str]()
        self.port = StreamPort(address, 115_200, write_timeout=60.0)
        self.port.begin(self._arrive)

    def _arrive(self, batch: Any) -> None:
        if isinstance(batch, PortChange):
            self.changes.append(batch.lost)
        else:
            self.data += b"".join(batch)

    def until(self, data: bytes, changes: int = 1) -> None:
        for _ in range(500):
            if self.data == data and len(self.changes) == changes:
                return
            self.port.step()
        raise AssertionError(self.__dict__)


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    monkeypatch.setattr(reopening_port, "_REOPEN_PERIOD", 0.0)
    with socket.create_server(("localhost", 0)) as listening:
        listening.settimeout(5.0)
        yield listening


def test_tcp_passes_bytes_both_ways_and_reopens_a_closed_connection(server: socket.socket) -> None:
    port = Port(f"localhost:{server.getsockname()[1]}")
    with server.accept()[0] as drive:
        port.port.send((b"PA", b"=1;"))
        assert drive.recv(100) == b"PA=1;"
        drive.sendall(b":")
        port.until(b":")
    port.until(b":", changes=2)
    assert port.changes[1] in ("closed by the other end", "Connection reset by peer")
    port.port.step()
    with server.accept()[0] as drive:
        drive.sendall(b"?")
        port.until(b":?", changes=3)
    port.port.close()
    port.port.close()


def test_serial_passes_bytes_and_reports_an_unplugged_adapter() -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    port = Port(os.ttyname(slave))
    port.port.send((b"/1 get pos\n",))
    assert os.read(master, 100) == b"/1 get pos\n"
    os.write(master, b"@01 0 OK\r\n")
    port.until(b"@01 0 OK\r\n")
    os.close(slave)
    os.close(master)
    port.until(b"@01 0 OK\r\n", changes=2)
    port.port.close()


def test_link_splits_lines_at_any_terminator_and_counts_garbage() -> None:
    link = TextLink("galil", b":?")
    link.open()
    assert link.receive([b" 1.0000", b" 2\r\n:", b"?:"]) == ["1.0000 2:", "?", ":"]
    assert link.receive([b"\xff\xfe:"]) == []
    assert link.receive([b"x" * 1100, b":?"]) == ["?"]
    assert link.receive([b"x" * 1100]) == []
    assert link.receive([b":"]) == [":"]
    assert (link.garbled, link.lines_received) == (3, 5)


def test_link_sends_nothing_before_it_is_opened() -> None:
    link = TextLink("galil", b":?")
    with pytest.raises(LinkError, match="galil is not open"):
        link.send(b"x")
    link.open()
    link.send(b"a")
    link.send(b"b")
    assert link.pop_outgoing() == (b"ab",)
