"""The drives behind a pseudo-terminal, reached with python-can and canopen."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import canopen
import pytest

from needle_core.can_frame import CanFrame
from needle_core.errors import UserError
from needle_sim.bus.pty_can import PtyCan
from needle_sim.bus.pty_port import PtyPort
from needle_sim.drives.drive_motion import LimitAction
from needle_sim.drives.emulated_bus import EmulatedBus
from needle_sim.drives.fault_commands import PlugOrder, obey

from .master import INSERTION, ROTATION, settings

LIMIT = 20.0


def troubles(bus: EmulatedBus) -> tuple[bool, bool, bool]:
    drives = bus.drives
    return bus.is_cut, drives["insertion"].motor.stalled, drives["rotation"].hung


def make_bus() -> EmulatedBus:
    drives = [settings(name, LimitAction.CLAMP) for name in ("insertion", "rotation")]
    # Booted long ago.
    return EmulatedBus(drives[0], drives[1], 0.0)


class Served:
    """A bus behind an adapter, served by a thread of its own."""

    def __init__(self, link: Path) -> None:
        self.bus = make_bus()
        self.bus.poll(time.monotonic())
        self.adapter = PtyCan(link)
        self._arrived: deque[tuple[CanFrame, ...]] = deque()
        self._end = threading.Event()
        self.adapter.open(self._arrived.append)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def until(self, condition: Callable[[], bool]) -> None:
        for _ in range(2000):
            if condition():
                return
            threading.Event().wait(0.005)
        raise AssertionError("timed out")

    def close(self) -> None:
        self._end.set()
        self._thread.join()
        self.adapter.close()

    def _run(self) -> None:
        while not self._end.wait(0.002):
            now = time.monotonic()
            while self._arrived:
                for frame in self._arrived.popleft():
                    self.bus.receive(frame, now)
            self.adapter.send(tuple(self.bus.poll(now)))


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    served = Served(tmp_path / "can")
    yield served
    served.close()
    assert list(tmp_path.iterdir()) == []


def patient_node(network: canopen.Network, node_id: int) -> Any:
    """Add a drive whose answers are waited for, whatever else keeps the machine busy."""
    node = network.add_node(node_id, None)
    node.sdo.RESPONSE_TIMEOUT = LIMIT
    return node


def test_stock_slcan_and_canopen_reach_both_drives(served: Served, tmp_path: Path) -> None:
    network = canopen.Network()
    network.connect(
        interface="slcan", channel=str(tmp_path / "can"), bitrate=500_000, sleep_after_open=0
    )
    try:
        for node_id, name in ((INSERTION, "insertion"), (ROTATION, "rotation")):
            node = patient_node(network, node_id)
            assert node.sdo.upload(0x1008, 0) == f"Emulated {name} drive".encode()
        network.nmt.send_command(1)
        for word in (0x06, 0x07, 0x0F):
            network.nodes[INSERTION].sdo.download(0x6040, 0, word.to_bytes(2, "little"))
        served.until(lambda: served.bus.drives["insertion"].state.value == 0x27)
        network.sync.transmit()
        served.until(lambda: served.bus.syncs == 1)
    finally:
        network.disconnect()


def test_unplugged_adapter_is_an_error_and_comes_back(served: Served, tmp_path: Path) -> None:
    link = tmp_path / "can"
    bus: Any = can.Bus(interface="slcan", channel=str(link), bitrate=500_000, sleep_after_open=0)
    served.adapter.plug(plugged_in=False)
    served.until(lambda: not link.exists())
    with pytest.raises((can.CanError, OSError)):
        for _ in range(100):
            bus.recv(0.01)
            bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
    bus.serialPortOrig.close()
    bus._is_shutdown = True
    served.adapter.plug(plugged_in=True)
    served.until(link.exists)
    network = canopen.Network()
    network.connect(interface="slcan", channel=str(link), bitrate=500_000, sleep_after_open=0)
    try:
        node = patient_node(network, INSERTION)
        assert node.sdo.upload(0x1000, 0) == b"\x92\x01\x04\x00"
    finally:
        network.disconnect()


def read(port: int, count: int) -> bytes:
    """Return so many bytes: a terminal hands on what was written in whatever pieces it likes."""
    data = b""
    while len(data) < count:
        data += os.read(port, count - len(data))
    return data


def test_closing_the_channel_throws_away_what_waits_and_opening_it_nothing(tmp_path: Path) -> None:
    port = PtyPort(tmp_path / "can")
    computer = os.open(port.path, os.O_RDWR | os.O_NOCTTY)
    try:
        for words in (b"C\r", b"S6\r", b"O\r"):
            os.write(computer, words)
            port.receive()
        # Whoever waits at the port was told that there is something to read.
        assert read(computer, 3) == b"\r\r\r"
        port.send([CanFrame(0x181, b"\1")])
        for words in (b"C\r", b"N\r"):
            os.write(computer, words)
            port.receive()
        assert read(computer, 7) == b"\rNSIM1\r"
    finally:
        os.close(computer)
        port.unplug()


def test_what_is_not_ours_is_left_alone(tmp_path: Path) -> None:
    file = tmp_path / "can"
    file.write_text("mine")
    with pytest.raises(UserError, match="can"):
        PtyPort(file)
    assert file.read_text() == "mine"
    # What a killed emulator leaves leads nowhere, or by now to somebody else's terminal.
    stale = tmp_path / "stale"
    stale.symlink_to("/dev/pts/ptmx")
    port = PtyPort(stale)
    assert stale.resolve() != Path("/dev/pts/ptmx")
    with pytest.raises(UserError, match="another emulator"):
        PtyPort(stale)
    assert stale.exists()
    port.unplug()
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize(
    "line",
    [
        "explode",
        "stall",
        "stall both",
        "stall insertion now",
        "emcy insertion",
        "emcy insertion x",
        "emcy rotation 0x10000",
        "cut_bus now",
    ],
)
def test_bad_commands_are_named_and_do_nothing(line: str) -> None:
    bus = make_bus()
    with pytest.raises(UserError, match=line.split(maxsplit=1)[0]):
        obey(line, bus, 0.0)
    assert troubles(bus) == (False, False, False)


def test_commands_do_what_they_say() -> None:
    bus = make_bus()
    bus.poll(1.0)
    for line in ("cut_bus", "stall insertion", "hang rotation", "emcy insertion 0x5530"):
        assert obey(line, bus, 1.0) is None
    assert troubles(bus) == (True, True, True)
    assert bus.drives["insertion"].error_code == 0x5530
    assert obey("unplug", bus, 1.0) is PlugOrder.OUT
    assert obey("restore", bus, 1.0) is PlugOrder.IN
    assert troubles(bus) == (False, False, False)
