"""The adapter at a pseudo-terminal, accessed with python-can."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from needle_core.can_frame import CanFrame
from needle_core.errors import UserError
from needle_sim.bus.pty_can import PtyCan


@pytest.fixture
def port(tmp_path: Path) -> Iterator[PtyCan]:
    port = PtyCan(tmp_path / "can")
    yield port
    port.plug(plugged_in=False)
    assert not (tmp_path / "can").is_symlink()


def computer(port: PtyCan) -> Any:
    return can.Bus(interface="slcan", channel=port.path, bitrate=500_000, sleep_after_open=0)


def received(port: PtyCan) -> tuple[CanFrame, ...]:
    """Return the frames that the adapter reads, in any number of pieces."""
    frames: tuple[CanFrame, ...] = ()
    for _ in range(100):
        frames += port.receive()
    return frames


def test_stock_slcan_exchanges_frames_through_the_port(port: PtyCan) -> None:
    with computer(port) as bus:
        bus.send(can.Message(arbitration_id=0x201, data=b"\x0f\0", is_extended_id=False))
        assert received(port) == (CanFrame(0x201, b"\x0f\0"),)
        port.send([CanFrame(0x181, b"\x37\2"), CanFrame(0x701, b"\5")])
        answers = [bus.recv(1.0) for _ in range(2)]
    assert [(m.arbitration_id, bytes(m.data)) for m in answers if m is not None] == [
        (0x181, b"\x37\2"),
        (0x701, b"\5"),
    ]


def test_an_unplugged_adapter_is_an_error_and_reconnects(port: PtyCan) -> None:
    link = Path(port.path)
    bus = computer(port)
    port.plug(plugged_in=False)
    assert not link.is_symlink()
    assert port.receive() == ()
    port.send([CanFrame(0x181)])
    with pytest.raises((can.CanError, OSError)):
        bus.recv(0.01)
    with pytest.raises((can.CanError, OSError)):
        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
    bus.serialPortOrig.close()
    bus._is_shutdown = True
    port.plug(plugged_in=True)
    with computer(port) as bus:
        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        assert received(port) == (CanFrame(0x80),)


def test_a_port_is_read_until_it_is_closed(tmp_path: Path) -> None:
    adapter = PtyCan(tmp_path / "can")
    received: list[CanFrame] = []

    def arrive(frames: tuple[CanFrame, ...]) -> None:
        received.extend(frames)
        adapter.send((CanFrame(0x181, b"\1"),))
        message = bus.recv(1.0)
        assert message is not None
        received.append(CanFrame(message.arbitration_id, bytes(message.data)))
        adapter.close()

    bus = computer(adapter)
    bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
    adapter.read(arrive)
    assert received == [CanFrame(0x80), CanFrame(0x181, b"\1")]
    assert list(tmp_path.iterdir()) == []
    bus.serialPortOrig.close()
    bus._is_shutdown = True


def read(terminal: int, count: int) -> bytes:
    """Return a number of bytes; a terminal may deliver them in any pieces."""
    data = b""
    while len(data) < count:
        data += os.read(terminal, count - len(data))
    return data


def test_closing_the_channel_drops_pending_output_and_opening_it_does_not(port: PtyCan) -> None:
    terminal = os.open(port.path, os.O_RDWR | os.O_NOCTTY)
    try:
        for words in (b"C\r", b"S6\r", b"O\r"):
            os.write(terminal, words)
            port.receive()
        # A waiting reader has been notified of the input.
        assert read(terminal, 3) == b"\r\r\r"
        port.send([CanFrame(0x181, b"\1")])
        for words in (b"C\r", b"N\r"):
            os.write(terminal, words)
            port.receive()
        assert read(terminal, 7) == b"\rNSIM1\r"
    finally:
        os.close(terminal)


def test_files_and_links_of_others_are_left_alone(tmp_path: Path) -> None:
    file = tmp_path / "can"
    file.write_text("mine")
    with pytest.raises(UserError, match="can"):
        PtyCan(file)
    assert file.read_text() == "mine"
    # The link of a killed emulator is dead, or leads to the terminal of another process.
    stale = tmp_path / "stale"
    stale.symlink_to("/dev/pts/ptmx")
    port = PtyCan(stale)
    assert stale.resolve() != Path("/dev/pts/ptmx")
    with pytest.raises(UserError, match="another emulator"):
        PtyCan(stale)
    assert stale.exists()
    port.plug(plugged_in=False)
    assert list(tmp_path.iterdir()) == [file]
