"""CAN port on slcan over a pseudo-terminal, virtual and socketcand.

The port's thread is not started: each test takes its steps as soon as their input is there.
"""

from __future__ import annotations

import os
import select
import socket
import tty
from collections.abc import Callable, Iterator
from typing import Any

import can
import pytest
from can.interfaces.slcan import slcanBus

from needle_core.can_frame import CanErrors, CanFrame
from needle_core.component import PortChange
from needle_core.ports import reopening_port
from needle_device_driver.link import can_port, text_bus
from needle_device_driver.link.can_port import Batch, CanPort, LinkSettings
from needle_device_driver.link.text_bus import SLCAN_BITRATES

PORTS: list[CanPort] = []
CONNECT = socket.create_connection


class Port:
    """A port that records frames and changes."""

    def __init__(self, kind: str, channel: str = "can0", **settings: Any) -> None:
        self.now = 0.0
        self.items: list[CanFrame | CanErrors] = []
        self.changes: list[str] = []
        self.port = CanPort(LinkSettings(kind, channel, **settings), 0.001, lambda: self.now)
        self.port.begin(self._arrive)
        PORTS.append(self.port)

    def _arrive(self, batch: Batch | PortChange) -> None:
        if isinstance(batch, PortChange):
            self.changes.append(batch.lost)
        else:
            self.items += batch

    @property
    def frames(self) -> list[bytes]:
        frames = [item for item in self.items if isinstance(item, CanFrame)]
        assert {frame.identifier for frame in frames} <= {0x181}
        return [frame.data for frame in frames]

    @property
    def errors(self) -> CanErrors:
        """Sum of the reported errors."""
        errors = [item for item in self.items if isinstance(item, CanErrors)]
        return CanErrors(sum(one.frames for one in errors), sum(one.refusals for one in errors))

    def until(self, condition: Callable[[], bool]) -> None:
        for _ in range(500):
            if condition():
                return
            self.port.step()
        raise AssertionError(self.__dict__)

    def send(self, cob_id: int, data: bytes = b"") -> None:
        self.port.send((CanFrame(cob_id, data),))


@pytest.fixture(autouse=True)
def _no_waiting(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(reopening_port, "_REOPEN_PERIOD", 0.0)
    monkeypatch.setattr(text_bus, "_REPLY_TIMEOUT", 0.05)
    yield
    while PORTS:
        PORTS.pop().close()


class Adapter:
    """A serial CAN adapter at the other end of a pseudo-terminal."""

    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)

    def read(self, wanted: bytes) -> bytes:
        """Return the written data up to the expected end, or all."""
        data = b""
        while wanted not in data and select.select([self.master], [], [], 1.0)[0]:
            data += os.read(self.master, 4096)
        return data

    def transmit(self, data: bytes) -> None:
        os.write(self.master, data)

    def unplug(self) -> None:
        os.close(self.master)
        os.close(self.slave)


@pytest.fixture
def adapter() -> Iterator[Adapter]:
    adapter = Adapter()
    yield adapter
    adapter.unplug()


def test_slcan_opens_with_the_bitrate_sends_frames_and_closes(adapter: Adapter) -> None:
    codes = {rate: f"S{code}" for code, rate in enumerate(SLCAN_BITRATES)}
    assert codes == slcanBus._BITRATES
    port = Port("slcan", adapter.path, bitrate=1_000_000)
    # First it ends a line of an earlier program.
    assert adapter.read(b"O\r") == b"\rC\rS8\rO\r"
    port.send(0x201, b"\x0f\x00\x08")
    port.send(0x80)
    assert adapter.read(b"t0800\r") == b"t20130F0008\rt0800\r"
    # The port is locked.
    second = Port("slcan", adapter.path)
    assert second.changes == ["another program uses it"]
    port.port.close()
    assert adapter.read(b"C\r").endswith(b"C\r")
    second.until(lambda: second.changes[1:] == [""])


def test_slcan_sends_a_frame_in_pieces(adapter: Adapter, monkeypatch: pytest.MonkeyPatch) -> None:
    port = Port("slcan", adapter.path)
    adapter.read(b"O\r")
    write = os.write
    with monkeypatch.context() as patch:
        patch.setattr(os, "write", lambda fd, data: write(fd, data[:3]))
        port.send(0x201, b"\x0f\x00\x08")
    assert adapter.read(b"\r") == b"t20130F0008\r"


def test_close_ends_the_thread_and_releases_the_adapter(adapter: Adapter) -> None:
    changes: list[Any] = []
    port = CanPort(LinkSettings("slcan", adapter.path))
    port.open(changes.append)
    adapter.read(b"O\r")
    for _ in range(2):
        port.close()
        assert not port._thread.is_alive()
    assert adapter.read(b"C\r") == b"C\r"
    assert changes == [PortChange()]


def test_slcan_receives_frames_in_any_pieces(adapter: Adapter) -> None:
    port = Port("slcan", adapter.path)
    adapter.transmit(b"\r\rz\rt1812")
    adapter.transmit(b"37")
    adapter.transmit(b"02\rt1812ABCD\rt18\rnonsense\rt181xZZ\r\x07" + b"?" * 100 + b"\rt1810\r")
    adapter.transmit(b"\r\n\r\nt18123702\r\nz\r\n\nt1811aB12F4\r\n\x07")
    port.until(lambda: len(port.frames) == 5 and port.errors == CanErrors(3, 2))
    assert port.frames == [b"\x37\x02", b"\xab\xcd", b"", b"\x37\x02", b"\xab"]
    assert port.changes == [""]


def test_slcan_sets_up_a_silent_adapter_again(adapter: Adapter) -> None:
    """The adapter restarts when its port is opened."""
    port = Port("slcan", adapter.path, bitrate=125_000)
    port.now = 0.4
    port.port.step()
    assert adapter.read(b"O\r") == b"\rC\rS4\rO\r"
    port.now = 0.41
    port.port.step()
    assert adapter.read(b"O\r") == b"\rC\rS4\rO\r"
    port.now = 0.8
    adapter.transmit(b"t1810\r")
    port.until(lambda: port.frames == [b""])
    # Not after a frame arrived.
    port.now = 1.1
    port.port.step()
    port.send(0x80)
    assert adapter.read(b"t0800\r") == b"t0800\r"


def test_slcan_reopens_an_unplugged_adapter(adapter: Adapter) -> None:
    unplugged = Adapter()
    port = Port("slcan", unplugged.path)
    unplugged.unplug()
    port.until(lambda: len(port.changes) == 2)
    assert port.changes[1]
    # Sending without an adapter raises no error.
    port.send(0x80)
    port.port._settings = LinkSettings("slcan", adapter.path)
    port.until(lambda: port.changes[-1] == "")
    adapter.read(b"O\r")
    port.send(0x80)
    assert adapter.read(b"t0800\r") == b"t0800\r"


def test_slcan_adapter_that_accepts_no_data_is_lost(adapter: Adapter) -> None:
    port = Port("slcan", adapter.path)
    while len(port.changes) == 1:
        port.port.send((CanFrame(0x201, bytes(8)),) * 1000)
    assert port.changes[1] == "accepted no data for 0.001 s"


@pytest.mark.parametrize("kind", ["slcan", "socketcan", "socketcand"])
def test_missing_adapter_is_reported_once_in_one_line(kind: str) -> None:
    port = Port(kind, "there-is-none", port=1)
    port.port.step()
    (why,) = port.changes
    assert why
    assert "\n" not in why


def test_virtual_passes_data_frames_both_ways() -> None:
    port = Port("virtual", "test_can_port")
    with can.Bus(interface="virtual", channel="test_can_port") as peer:
        for message in (
            can.Message(arbitration_id=0x181, is_error_frame=True),
            can.Message(arbitration_id=0x181, is_extended_id=True, data=b"\x01"),
            can.Message(arbitration_id=0x181, is_remote_frame=True, is_extended_id=False),
            can.Message(arbitration_id=0x181, is_extended_id=False, data=b"\x02"),
        ):
            peer.send(message)
        port.until(lambda: port.frames == [b"\x02"])
        port.send(0x77F, b"\x05")
        got = peer.recv(0.0)
        assert got is not None
        assert (got.arbitration_id, bytes(got.data)) == (0x77F, b"\x05")
    assert port.errors == CanErrors(1)


class Daemon:
    """A socketcand server that sends all its replies in advance."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, answer: bytes = b"< hi >< ok >< ok >"
    ) -> None:
        with socket.create_server(("localhost", 0)) as server:
            self.client = CONNECT(server.getsockname())
            self.peer, _ = server.accept()
        self.peer.sendall(answer)
        self.peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        monkeypatch.setattr(socket, "create_connection", lambda *_: self.client)
        monkeypatch.setattr(can_port, "_RECEIVE_TIMEOUT", 0.0)

    def close(self) -> None:
        self.client.close()
        self.peer.close()


def test_socketcand_passes_frames_and_detects_a_closed_connection(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    daemon = Daemon(monkeypatch)
    port = Port("socketcand")
    assert daemon.peer.recv(100) == b"< open can0 >< rawmode >"
    port.send(0x201, b"\x0f\x00\x08")
    assert daemon.peer.recv(100) == b"< send 201 3 f 0 8 >"
    daemon.peer.sendall(b"< frame 181 12.5 3702 >")
    port.until(lambda: port.frames == [b"\x37\x02"])
    daemon.peer.close()
    # Detected without sending.
    port.until(lambda: "closed by the other end" in port.changes)
    daemon.close()


def test_socketcand_receives_frames_in_any_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    daemon = Daemon(monkeypatch, b"< hi >< ok >< ok >< frame 181 1.5 3702 >< frame 18")
    port = Port("socketcand")
    # A malformed frame, an invalid one, two messages without end, and an error of the bus.
    rest = b"1 1.6  >\xff\xfe>< frame x y z >" + b"?" * 300 + b">< error 004 1.7 >"
    rest += b"< frame 181 1.8 ab >" + b"?" * 190 + b"< frame 181 1.9 cd >"
    for byte in rest:
        daemon.peer.sendall(bytes([byte]))
        port.port.step()
    port.until(lambda: len(port.frames) == 4)
    assert port.frames == [b"\x37\x02", b"", b"\xab", b"\xcd"]
    # A message without end counts once or more, by the number of its pieces.
    assert port.errors.frames >= 3
    assert port.changes == [""]
    daemon.close()


def test_socketcand_refuses_another_server(monkeypatch: pytest.MonkeyPatch) -> None:
    for answer, why in (
        (b"SSH-2.0-OpenSSH_9.2\r\n", "got nothing"),
        (b"< hello >", "got '< hello >'"),
        (b"< hi >< error could not open bus >", "got '< error could not open bus >'"),
    ):
        daemon = Daemon(monkeypatch, answer)
        assert why in Port("socketcand").changes[0]
        assert daemon.client.fileno() == -1, "closed"
        daemon.close()
