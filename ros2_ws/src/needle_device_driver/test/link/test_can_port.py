"""Links: slcan over a pseudo-terminal, virtual, socketcand; opened, lost, opened again."""

from __future__ import annotations

import contextlib
import os
import queue
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from needle_core.can_frame import CanErrors, CanFrame
from needle_core.component import PortChange
from needle_core.errors import UserError
from needle_device_driver.link import socketcand_bus
from needle_device_driver.link.can_port import Batch, CanPort
from needle_device_driver.link.link_settings import SLCAN_BITRATES, LinkSettings
from needle_device_driver.link.slcan_bus import SlcanBus


class Adapter:
    """The far end of a pseudo-terminal, where a serial CAN adapter would be."""

    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)

    def read(self, wanted: bytes) -> bytes:
        data = b""
        until = time.monotonic() + 5.0
        while wanted not in data:
            assert time.monotonic() < until, data
            data += os.read(self.master, 4096)
        return data

    def say(self, data: bytes) -> None:
        os.write(self.master, data)

    def say_all(self, pieces: list[bytes]) -> None:
        for piece in pieces:
            self.say(piece)

    def unplug(self) -> None:
        for fd in (self.master, self.slave):
            if fd >= 0:
                os.close(fd)
        self.master = self.slave = -1


@pytest.fixture
def adapter() -> Iterator[Adapter]:
    adapter = Adapter()
    yield adapter
    adapter.unplug()


class Port:
    """A port, and what has come through it."""

    def __init__(self, settings: LinkSettings, clock: Callable[[], float] = time.monotonic) -> None:
        self.items: list[CanFrame | CanErrors | PortChange] = []
        self._arrived: queue.SimpleQueue[Batch | PortChange] = queue.SimpleQueue()
        self._port = CanPort(settings, clock)
        self._port.open(self._arrived.put)
        self.take(0.0)

    def take(self, wait: float) -> None:
        with contextlib.suppress(queue.Empty):
            while True:
                batch = self._arrived.get(timeout=wait)
                self.items += [batch] if isinstance(batch, PortChange) else batch

    def until(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 5.0
        while not condition():
            assert time.monotonic() < deadline, self.items
            self.take(0.02)

    def send(self, cob_id: int, data: bytes = b"") -> None:
        self._port.send((CanFrame(cob_id, data),))

    def close(self) -> None:
        self._port.close()
        assert not self._port._thread.is_alive()

    def frames(self, cob_id: int) -> list[bytes]:
        frames = [item for item in self.items if isinstance(item, CanFrame)]
        assert all(frame.time is not None for frame in frames)
        return [frame.data for frame in frames if frame.identifier == cob_id]

    @property
    def changes(self) -> list[str]:
        return [item.lost for item in self.items if isinstance(item, PortChange)]

    @property
    def errors(self) -> int:
        return sum(item.frames for item in self.items if isinstance(item, CanErrors))

    @property
    def refusals(self) -> int:
        return sum(item.refusals for item in self.items if isinstance(item, CanErrors))


@pytest.fixture
def make_port() -> Iterator[Callable[[LinkSettings], Port]]:
    ports: list[Port] = []

    def make(settings: LinkSettings) -> Port:
        ports.append(Port(settings))
        return ports[-1]

    yield make
    for port in ports:
        port.close()


Make = Callable[[LinkSettings], Port]


def test_slcan_bitrates_are_those_that_the_adapter_takes() -> None:
    assert set(SLCAN_BITRATES) == set(SlcanBus._BITRATES)


def test_slcan_opens_with_the_bitrate_and_sends_frames(adapter: Adapter, make_port: Make) -> None:
    port = make_port(LinkSettings("slcan", adapter.path, bitrate=1_000_000))
    # First the end of a line that a killed predecessor may have left.
    assert adapter.read(b"O\r") == b"\rC\rS8\r\rO\r"
    port.send(0x201, b"\x0f\x00\x08")
    port.send(0x80)
    assert adapter.read(b"t0800\r") == b"t20130F0008\rt0800\r"
    port.close()
    assert adapter.read(b"C\r") == b"C\r"


def test_slcan_takes_what_comes_in_any_pieces_and_counts_what_is_no_frame(
    adapter: Adapter, make_port: Make
) -> None:
    port = make_port(LinkSettings("slcan", adapter.path))
    adapter.say(b"\r\rz\rt1812")
    adapter.say(b"37")
    adapter.say(b"02\rt1812ABCD\rt18\rnonsense\rt181xZZ\r\x07" + b"?" * 100 + b"\rt1810\r")
    port.until(lambda: len(port.frames(0x181)) >= 3)
    assert port.frames(0x181) == [b"\x37\x02", b"\xab\xcd", b""]
    port.until(lambda: port.errors + port.refusals >= 4)
    assert port.changes == [""]


def test_slcan_lines_may_end_with_a_line_feed_too(adapter: Adapter, make_port: Make) -> None:
    port = make_port(LinkSettings("slcan", adapter.path))
    adapter.say(b"\r\n\r\nt18123702\r\nz\r\n\nt1811aB12F4\r\n")
    port.until(lambda: len(port.frames(0x181)) >= 2)
    assert port.frames(0x181) == [b"\x37\x02", b"\xab"]
    assert port.errors == 0


def test_slcan_that_is_silent_is_told_to_open_again(adapter: Adapter) -> None:
    # It starts when its port is opened, and hears nothing meanwhile.
    now = [0.0]
    port = Port(LinkSettings("slcan", adapter.path, bitrate=125_000), lambda: now[0])
    hello = b"\rC\rS4\r\rO\r"
    assert adapter.read(b"O\r") == hello
    now[0] = 0.5
    assert adapter.read(b"O\r") == hello
    now[0] = 0.8
    adapter.say(b"t1810\r")
    port.until(lambda: len(port.frames(0x181)) == 1)
    # Not once it was heard.
    now[0] = 1.1
    port.send(0x80)
    assert adapter.read(b"t0800\r") == b"t0800\r"
    assert port.changes == [""]
    port.close()


def test_slcan_port_is_one_programs_alone(adapter: Adapter, make_port: Make) -> None:
    first = make_port(LinkSettings("slcan", adapter.path))
    second = make_port(LinkSettings("slcan", adapter.path))
    assert second.changes == ["another program uses it"]
    first.close()
    second.until(lambda: second.changes[1:] == [""])


def test_slcan_refusals_are_counted(adapter: Adapter, make_port: Make) -> None:
    port = make_port(LinkSettings("slcan", adapter.path))
    adapter.say(b"\r\r\x07\x07t1810\r")
    port.until(lambda: port.refusals == 2 and len(port.frames(0x181)) == 1)


def test_slcan_a_flood_of_frames_is_taken_whole(adapter: Adapter, make_port: Make) -> None:
    port = make_port(LinkSettings("slcan", adapter.path))
    wanted = [number.to_bytes(4, "little") for number in range(2000)]
    data = [b"t1814" + frame.hex().upper().encode() + b"\r" for frame in wanted]
    sender = threading.Thread(target=lambda: adapter.say_all(data))
    sender.start()
    port.until(lambda: len(port.frames(0x181)) == len(wanted))
    sender.join()
    assert port.frames(0x181) == wanted


def test_slcan_unplugged_is_told_and_opened_again(
    adapter: Adapter, make_port: Make, tmp_path: Path
) -> None:
    name = tmp_path / "can"
    name.symlink_to(adapter.path)
    port = make_port(LinkSettings("slcan", str(name)))
    assert port.changes == [""]
    adapter.unplug()
    port.until(lambda: len(port.changes) >= 2)
    assert all(port.changes[1:])
    # Nothing to send through, and nothing raised.
    port.send(0x80)
    again = Adapter()
    name.unlink()
    name.symlink_to(again.path)
    port.until(lambda: port.changes[-1] == "")
    again.read(b"O\r")
    port.send(0x80)
    again.read(b"t0800\r")
    port.close()
    again.unplug()


def test_slcan_that_takes_nothing_is_lost_and_hangs_nobody(
    adapter: Adapter, make_port: Make
) -> None:
    port = make_port(LinkSettings("slcan", adapter.path))
    fill(port, 100_000)


@pytest.mark.parametrize(
    "settings",
    [
        LinkSettings("slcan", "/dev/there-is-none"),
        LinkSettings("slcan", "/dev/null"),
        LinkSettings("socketcan", "no-such-can"),
        LinkSettings("socketcand", "can0", host="localhost", port=1),
    ],
    ids=str,
)
def test_what_is_not_there_is_told_in_one_line(settings: LinkSettings, make_port: Make) -> None:
    port = make_port(settings)
    assert port.changes[0]
    assert not any("\n" in change for change in port.changes)


def test_settings_without_a_channel_or_of_no_kind_are_refused() -> None:
    with pytest.raises(UserError, match="channel"):
        LinkSettings("socketcan", "")
    with pytest.raises(UserError, match="link"):
        LinkSettings("bluetooth", "x")
    with pytest.raises(UserError, match="bitrate"):
        LinkSettings("slcan", "/dev/ttyACM0", bitrate=123)


def test_virtual_carries_frames_both_ways_and_not_those_of_others(make_port: Make) -> None:
    port = make_port(LinkSettings("virtual", "test_can_link"))
    with can.Bus(interface="virtual", channel="test_can_link") as peer:
        for message in (
            can.Message(arbitration_id=0x181, is_error_frame=True),
            can.Message(arbitration_id=0x181, is_extended_id=True, data=b"\x01"),
            can.Message(arbitration_id=0x181, is_remote_frame=True, is_extended_id=False),
            can.Message(arbitration_id=0x181, is_extended_id=False, data=b"\x02"),
        ):
            peer.send(message)
        port.until(lambda: port.frames(0x181) == [b"\x02"])
        port.send(0x77F, b"\x05")
        got = peer.recv(5.0)
        assert got is not None
        assert (got.arbitration_id, bytes(got.data)) == (0x77F, b"\x05")
    assert port.errors == 1


class Daemon:
    """A socketcand for one client; what follows its last `ok` comes with it."""

    def __init__(self, *says: bytes) -> None:
        self.says = says or (b"< hi >", b"< ok >", b"< ok >")
        self.server = socket.create_server(("localhost", 0))
        self.port = self.server.getsockname()[1]
        self.got = b""
        self.connection: socket.socket | None = None
        self.thread = threading.Thread(target=self._serve, daemon=True)
        self.thread.start()

    def _serve(self) -> None:
        self.connection, _ = self.server.accept()
        for number, words in enumerate(self.says):
            if number:
                self.got += self.connection.recv(100)
            self.connection.sendall(words)

    def close(self) -> None:
        if self.connection is not None:
            self.connection.close()
        self.server.close()


def test_socketcand_carries_frames_and_its_end_is_a_lost_link(make_port: Make) -> None:
    daemon = Daemon()
    port = make_port(LinkSettings("socketcand", "can0", host="localhost", port=daemon.port))
    daemon.thread.join(5.0)
    assert daemon.connection is not None
    port.send(0x201, b"\x0f\x00\x08")
    assert daemon.connection.recv(100) == b"< send 201 3 f 0 8 >"
    daemon.connection.sendall(b"< frame 181 12.5 3702 >")
    port.until(lambda: port.frames(0x181) == [b"\x37\x02"])
    assert daemon.got == b"< open can0 >< rawmode >"
    daemon.close()
    # Noticed without a word sent.
    port.until(lambda: "the server hung up" in port.changes)


@pytest.mark.parametrize("length", [1, 7, 150, 250, 1000])
def test_socketcand_frames_may_come_with_the_answer_in_any_pieces(
    make_port: Make, length: int
) -> None:
    daemon = Daemon(b"< hi >", b"< ok >", b"< ok >< frame 181 1.5 3702 >< frame 18")
    port = make_port(LinkSettings("socketcand", "can0", host="localhost", port=daemon.port))
    daemon.thread.join(5.0)
    assert daemon.connection is not None
    daemon.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    # Five errors: no frame, a frame of nonsense, two that do not end, and the bus's own.
    rest = b"1 1.6  >\xff\xfe>< frame x y z >" + b"?" * 300 + b">< error 004 1.7 >"
    rest += b"< frame 181 1.8 ab >" + b"?" * 300 + b"< frame 181 1.9 cd >"
    for start in range(0, len(rest), length):
        daemon.connection.sendall(rest[start : start + length])
    port.until(lambda: len(port.frames(0x181)) == 4)
    assert port.frames(0x181) == [b"\x37\x02", b"", b"\xab", b"\xcd"]
    assert port.errors == 5
    assert port.changes == [""]
    daemon.close()


@pytest.mark.parametrize(
    ("says", "why"),
    [
        ([b""], "got nothing"),
        ([b"SSH-2.0-OpenSSH_9.2\r\n"], "got nothing"),
        ([b"< hello >"], "got '< hello >'"),
        ([b"< hi >", b"< error could not open bus >"], "got '< error could not open bus >'"),
    ],
)
def test_socketcand_that_is_none_is_refused_and_hangs_nobody(
    make_port: Make, monkeypatch: pytest.MonkeyPatch, says: list[bytes], why: str
) -> None:
    monkeypatch.setattr(socketcand_bus, "_ANSWER_WAIT", 0.2)
    daemon = Daemon(*says)
    port = make_port(LinkSettings("socketcand", "can0", host="localhost", port=daemon.port))
    assert why in port.changes[0]
    daemon.close()


def test_socketcand_that_takes_nothing_is_lost_and_hangs_nobody(make_port: Make) -> None:
    daemon = Daemon()
    port = make_port(LinkSettings("socketcand", "can0", host="localhost", port=daemon.port))
    fill(port, 1_000_000)
    daemon.close()


def fill(port: Port, most: int) -> None:
    """Send until the port tells that it is lost."""
    for _ in range(most):
        port.send(0x201, bytes(8))
        port.take(0.0)
        if any("takes nothing" in change for change in port.changes):
            return
    raise AssertionError(port.changes)
