"""The adapter at a pseudo-terminal, accessed with python-can."""

from __future__ import annotations

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
