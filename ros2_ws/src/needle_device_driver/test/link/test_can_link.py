"""Links: slcan over a pseudo-terminal, virtual, socketcand; opened, lost, opened again."""

from __future__ import annotations

import os
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from needle_core.errors import UserError
from needle_device_driver.link import socketcand_bus
from needle_device_driver.link.can_link import CanLink, open_bus
from needle_device_driver.link.frame_link import LinkError
from needle_device_driver.link.link_settings import SLCAN_BITRATES, LinkSettings
from needle_device_driver.link.object_access import DriveError, ObjectAccess
from needle_device_driver.link.objects import DEVICE_TYPE
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


@pytest.fixture
def make_link() -> Iterator[Callable[[LinkSettings], CanLink]]:
    links: list[CanLink] = []

    def make(settings: LinkSettings) -> CanLink:
        links.append(CanLink(settings, time.monotonic))
        return links[-1]

    yield make
    for link in links:
        link.close()


Make = Callable[[LinkSettings], CanLink]


def wait_for(link: CanLink, condition: Callable[[], bool]) -> None:
    with link.arrival:
        assert link.arrival.wait_for(condition, 5.0)


def received(link: CanLink, cob_id: int) -> list[bytes]:
    frames: list[bytes] = []

    def take(data: bytes, _: float) -> None:
        with link.arrival:
            frames.append(data)
            link.arrival.notify_all()

    link.subscribe(cob_id, take)
    return frames


def test_slcan_bitrates_are_those_that_the_adapter_takes() -> None:
    assert set(SLCAN_BITRATES) == set(SlcanBus._BITRATES)


def test_slcan_opens_with_the_bitrate_and_sends_frames(adapter: Adapter, make_link: Make) -> None:
    link = make_link(LinkSettings("slcan", adapter.path, bitrate=1_000_000))
    link.open()
    # First the end of a line that a killed predecessor may have left.
    assert adapter.read(b"O\r") == b"\rC\rS8\r\rO\r"
    link.send(0x201, b"\x0f\x00\x08")
    link.send(0x80)
    assert adapter.read(b"t0800\r") == b"t20130F0008\rt0800\r"
    link.close()
    assert adapter.read(b"C\r") == b"C\r"


def test_slcan_takes_what_comes_in_any_pieces_and_counts_what_is_no_frame(
    adapter: Adapter, make_link: Make
) -> None:
    link = make_link(LinkSettings("slcan", adapter.path))
    frames = received(link, 0x181)
    link.open()
    adapter.say(b"\r\rz\rt1812")
    adapter.say(b"37")
    adapter.say(b"02\rt1812ABCD\rt18\rnonsense\rt181xZZ\r\x07" + b"?" * 100 + b"\rt1810\r")
    wait_for(link, lambda: len(frames) >= 3)
    assert frames == [b"\x37\x02", b"\xab\xcd", b""]
    assert link.errors >= 4
    assert not link.lost


def test_slcan_lines_may_end_with_a_line_feed_too(adapter: Adapter, make_link: Make) -> None:
    link = make_link(LinkSettings("slcan", adapter.path))
    frames = received(link, 0x181)
    link.open()
    adapter.say(b"\r\n\r\nt18123702\r\nz\r\n\nt1811aB12F4\r\n")
    wait_for(link, lambda: len(frames) >= 2)
    assert frames == [b"\x37\x02", b"\xab"]
    assert link.errors == 0


def test_slcan_that_is_silent_is_told_to_open_again(adapter: Adapter) -> None:
    # It starts when its port is opened, and hears nothing meanwhile.
    now = [0.0]
    link = CanLink(LinkSettings("slcan", adapter.path, bitrate=125_000), lambda: now[0])
    link.open()
    hello = b"\rC\rS4\r\rO\r"
    assert adapter.read(b"O\r") == hello
    link.open()
    now[0] = 0.5
    link.open()
    assert adapter.read(b"O\r") == hello
    frames = received(link, 0x181)
    now[0] = 1.0
    adapter.say(b"t1810\r")
    wait_for(link, lambda: len(frames) == 1)
    link.open()
    link.send(0x80)
    # Not once it was heard.
    assert adapter.read(b"t0800\r") == b"t0800\r"
    assert link.openings == 1
    link.close()


def test_slcan_port_is_one_programs_alone(adapter: Adapter, make_link: Make) -> None:
    link = make_link(LinkSettings("slcan", adapter.path))
    link.open()
    with pytest.raises(LinkError, match=r"cannot open.*another program uses it"):
        make_link(LinkSettings("slcan", adapter.path)).open()
    link.close()
    make_link(LinkSettings("slcan", adapter.path)).open()


def test_slcan_that_refuses_is_named_where_nobody_answers(
    adapter: Adapter, make_link: Make
) -> None:
    link = make_link(LinkSettings("slcan", adapter.path))
    frames = received(link, 0x181)
    link.open()
    adapter.say(b"\r\r\x07\x07t1810\r")
    wait_for(link, lambda: len(frames) == 1)
    assert link.refused == 2
    with pytest.raises(DriveError, match=r"does not answer.*the adapter refuses"):
        link.run(ObjectAccess(link, 1).read(DEVICE_TYPE))


def test_slcan_a_flood_of_frames_is_taken_whole(adapter: Adapter, make_link: Make) -> None:
    link = make_link(LinkSettings("slcan", adapter.path))
    frames = received(link, 0x181)
    link.open()
    wanted = [number.to_bytes(4, "little") for number in range(2000)]
    data = [b"t1814" + frame.hex().upper().encode() + b"\r" for frame in wanted]
    sender = threading.Thread(target=lambda: adapter.say_all(data))
    sender.start()
    wait_for(link, lambda: len(frames) == len(wanted))
    sender.join()
    assert frames == wanted


def test_slcan_unplugged_is_named_and_opened_again_as_another_network(
    adapter: Adapter, make_link: Make, tmp_path: Path
) -> None:
    port = tmp_path / "can"
    port.symlink_to(adapter.path)
    link = make_link(LinkSettings("slcan", str(port)))
    link.open()
    first = link.sdo(1)
    adapter.unplug()
    wait_for(link, lambda: bool(link.lost))
    assert str(port) in link.lost
    with pytest.raises(LinkError, match="is lost"):
        link.send(0x80)
    with pytest.raises(LinkError, match="is lost"):
        link.sdo(1)
    with pytest.raises(LinkError, match="cannot open"):
        link.open()
    again = Adapter()
    port.unlink()
    port.symlink_to(again.path)
    link.open()
    assert not link.lost
    assert link.sdo(1) is not first
    link.send(0x80)
    again.read(b"t0800\r")
    link.close()
    again.unplug()


def test_slcan_that_takes_nothing_is_lost_and_hangs_nobody(
    adapter: Adapter, make_link: Make
) -> None:
    link = make_link(LinkSettings("slcan", adapter.path))
    link.open()
    with pytest.raises(LinkError, match="takes nothing"):
        for _ in range(100_000):
            link.send(0x201, bytes(8))


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
def test_what_is_not_there_is_refused_in_one_line(settings: LinkSettings) -> None:
    with pytest.raises(LinkError, match="cannot open") as caught:
        open_bus(settings)
    assert "\n" not in str(caught.value)
    assert settings.channel in str(caught.value)


def test_settings_without_a_channel_or_of_no_kind_are_refused() -> None:
    with pytest.raises(UserError, match="channel"):
        LinkSettings("socketcan", "")
    with pytest.raises(UserError, match="link"):
        LinkSettings("bluetooth", "x")
    with pytest.raises(UserError, match="bitrate"):
        LinkSettings("slcan", "/dev/ttyACM0", bitrate=123)


def test_virtual_carries_frames_both_ways_and_not_those_of_others(make_link: Make) -> None:
    link = make_link(LinkSettings("virtual", "test_can_link"))
    frames = received(link, 0x181)
    link.open()
    with can.Bus(interface="virtual", channel="test_can_link") as peer:
        for message in (
            can.Message(arbitration_id=0x181, is_error_frame=True),
            can.Message(arbitration_id=0x181, is_extended_id=True, data=b"\x01"),
            can.Message(arbitration_id=0x181, is_remote_frame=True, is_extended_id=False),
            can.Message(arbitration_id=0x181, is_extended_id=False, data=b"\x02"),
        ):
            peer.send(message)
        wait_for(link, lambda: frames == [b"\x02"])
        link.send(0x77F, b"\x05")
        got = peer.recv(5.0)
        assert got is not None
        assert (got.arbitration_id, bytes(got.data)) == (0x77F, b"\x05")
    assert link.errors == 1


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


def test_socketcand_carries_frames_and_its_end_is_a_lost_link(make_link: Make) -> None:
    daemon = Daemon()
    link = make_link(LinkSettings("socketcand", "can0", host="localhost", port=daemon.port))
    frames = received(link, 0x181)
    link.open()
    daemon.thread.join(5.0)
    assert daemon.connection is not None
    link.send(0x201, b"\x0f\x00\x08")
    assert daemon.connection.recv(100) == b"< send 201 3 f 0 8 >"
    daemon.connection.sendall(b"< frame 181 12.5 3702 >")
    wait_for(link, lambda: frames == [b"\x37\x02"])
    assert daemon.got == b"< open can0 >< rawmode >"
    daemon.close()
    # Noticed without a word sent. A closed connection is readable for ever: nobody reads on.
    wait_for(link, lambda: bool(link.lost))
    assert link.lost.endswith("the server hung up")
    with pytest.raises(LinkError, match="lost"):
        link.send(0x80)
    thread = link._thread
    assert thread is not None
    thread.join(5.0)
    assert not thread.is_alive()


@pytest.mark.parametrize("length", [1, 7, 150, 250, 1000])
def test_socketcand_frames_may_come_with_the_answer_in_any_pieces(
    make_link: Make, length: int
) -> None:
    daemon = Daemon(b"< hi >", b"< ok >", b"< ok >< frame 181 1.5 3702 >< frame 18")
    link = make_link(LinkSettings("socketcand", "can0", host="localhost", port=daemon.port))
    frames = received(link, 0x181)
    link.open()
    daemon.thread.join(5.0)
    assert daemon.connection is not None
    daemon.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    # Five errors: no frame, a frame of nonsense, two that do not end, and the bus's own.
    rest = b"1 1.6  >\xff\xfe>< frame x y z >" + b"?" * 300 + b">< error 004 1.7 >"
    rest += b"< frame 181 1.8 ab >" + b"?" * 300 + b"< frame 181 1.9 cd >"
    for start in range(0, len(rest), length):
        daemon.connection.sendall(rest[start : start + length])
    wait_for(link, lambda: len(frames) == 4)
    assert frames == [b"\x37\x02", b"", b"\xab", b"\xcd"]
    assert link.errors == 5
    assert not link.lost
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
    make_link: Make, monkeypatch: pytest.MonkeyPatch, says: list[bytes], why: str
) -> None:
    monkeypatch.setattr(socketcand_bus, "_ANSWER_WAIT", 0.2)
    daemon = Daemon(*says)
    link = make_link(LinkSettings("socketcand", "can0", host="localhost", port=daemon.port))
    with pytest.raises(LinkError, match="cannot open socketcand") as caught:
        link.open()
    assert why in str(caught.value)
    daemon.close()


def test_socketcand_that_takes_nothing_is_lost_and_hangs_nobody(make_link: Make) -> None:
    daemon = Daemon()
    link = make_link(LinkSettings("socketcand", "can0", host="localhost", port=daemon.port))
    link.open()
    with pytest.raises(LinkError, match="takes nothing"):
        for _ in range(1_000_000):
            link.send(0x201, bytes(8))
    daemon.close()
