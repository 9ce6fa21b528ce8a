"""The driver's 50 Hz cycle beside stock python-can and canopen, on the same emulated drives.

Each way moves both axes for a while over a pseudo-terminal; the drives' process notes when each
SYNC arrives. The ways take turns, so that what else the machine does falls on all of them.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import queue
import select
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import can
import canopen
import numpy as np
from canopen.objectdictionary import (
    INTEGER8,
    INTEGER32,
    UNSIGNED8,
    UNSIGNED16,
    UNSIGNED32,
    ODRecord,
    ODVariable,
)
from canopen.profiles.p402 import BaseNode402

from needle_core.component import PortChange
from needle_device_driver.cia402.cia402_axis import Cia402Axis
from needle_device_driver.cia402.drive_cycle import DriveCycle
from needle_device_driver.link.can_port import Batch, CanPort
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.link_settings import LinkSettings
from needle_device_driver.parameters import DeviceDriverParameters
from needle_device_driver.procedure import Procedure, T, run
from needle_sim.bus.pty_can import PtyPort
from needle_sim.drive_emulator import DriveEmulatorParameters
from needle_sim.drives.emulated_bus import EmulatedBus

PERIOD = 0.02
CYCLES = 250
TURNS = 3
NODES = (1, 2)
_SET_UP_PATIENCE = 5.0  # [s]
BITRATE = 500_000
# 2 mm/s and 1 rad/s.
COUNTS_PER_CYCLE = (800, 209)


@dataclass(frozen=True)
class Way:
    """A way to run the cycle: its key, name, p99 delay from set-points to SYNC, CPU share."""

    key: str
    what: str
    delay_p99_ms: float
    cpu_percent: float


class Client(Protocol):
    """Something that moves both axes."""

    def cycle(self, number: int) -> None:
        """Send set-points number `number` and SYNC, take the answers."""

    def close(self) -> None:
        """Let go."""


class Driver:
    """needle_device_driver's own cycle, its supervisor and ROS apart."""

    def __init__(self, channel: str) -> None:
        values = DeviceDriverParameters()
        settings = LinkSettings("slcan", channel, BITRATE)
        self._link = FrameLink(settings.link_name)
        self._arrived: queue.SimpleQueue[Batch | PortChange] = queue.SimpleQueue()
        self._port = CanPort(settings)
        self._port.open(self._arrived.put)
        self._axes = [
            Cia402Axis(name, values.drive(name), self._link, period=PERIOD, watchdog=0.5)
            for name in ("insertion", "rotation")
        ]
        self._cycle = DriveCycle(self._link, self._axes, PERIOD)
        for axis in self._axes:
            self._run(axis.configure())
            axis.power(True)
        while not all(axis.poll(0.0).powered for axis in self._axes):
            self._run(self._cycle.exchange(PERIOD / 2))
            time.sleep(PERIOD)
        self._starts = [axis.poll(0.0).position for axis in self._axes]
        self._units = [values.drive(axis.name).counts_per_unit for axis in self._axes]

    def cycle(self, number: int) -> None:
        """Run one cycle as the node does."""
        for axis, start, counts, unit in zip(
            self._axes, self._starts, COUNTS_PER_CYCLE, self._units, strict=True
        ):
            axis.start_move(start + (number + 1) * counts / unit, counts / unit / PERIOD)
        self._run(self._cycle.exchange(PERIOD / 2))

    def close(self) -> None:
        """Switch off."""
        for axis in self._axes:
            self._run(axis.close())
        self._port.close()

    def _run(self, procedure: Procedure[T]) -> T:
        return run(procedure, self._wait, self._now)

    def _now(self) -> float:
        self._link.now = time.monotonic()
        return self._link.now

    def _wait(self, is_there: Callable[[], bool], seconds: float) -> None:
        """Send what is to be sent, and take what comes."""
        self._port.send(self._link.pop_outgoing())
        until = self._now() + seconds
        with contextlib.suppress(queue.Empty):
            while not is_there():
                item = self._arrived.get(timeout=max(until - self._now(), 0.0))
                if isinstance(item, PortChange):
                    self._link.set_port_error(item.lost)
                else:
                    self._link.receive(item)


class PlainSlcan:
    """Frames of python-can's slcan as it comes, answers by its Notifier."""

    def __init__(self, channel: str) -> None:
        self._bus = can.Bus(interface="slcan", channel=channel, bitrate=BITRATE, sleep_after_open=0)
        self._answers = threading.Semaphore(0)
        self._notifier = can.Notifier(self._bus, [self._take])
        _map_pdos(self._sdo)
        self._send(0x000, b"\x01\x00")
        for node in NODES:
            for word in (0x06, 0x07, 0x0F):
                self._send(0x200 + node, word.to_bytes(2, "little") + b"\x08")
        time.sleep(PERIOD)

    def cycle(self, number: int) -> None:
        """Send set-points and SYNC; wait for both positions."""
        for node, counts in zip(NODES, COUNTS_PER_CYCLE, strict=True):
            self._send(0x300 + node, ((number + 1) * counts).to_bytes(4, "little", signed=True))
        self._send(0x080, b"")
        for _ in NODES:
            self._answers.acquire(timeout=PERIOD / 2)

    def close(self) -> None:
        """Switch off."""
        self._notifier.stop()
        self._bus.shutdown()

    def _take(self, message: can.Message) -> None:
        if message.arbitration_id & ~0x7F == 0x280:
            self._answers.release()

    def _sdo(self, node: int, index: int, subindex: int, data: bytes) -> None:
        head = bytes([0x23 | (4 - len(data)) << 2]) + index.to_bytes(2, "little")
        self._send(0x600 + node, head + bytes([subindex]) + data.ljust(4, b"\0"))
        time.sleep(0.002)

    def _send(self, identifier: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))


class Node402:
    """canopen's BaseNode402 on python-can's slcan."""

    def __init__(self, channel: str) -> None:
        # It asks for a reading that nobody sends before the first SYNC, and says so.
        logging.getLogger("canopen.profiles").setLevel(logging.ERROR)
        self._network = canopen.Network()
        self._network.connect(
            interface="slcan", channel=channel, bitrate=BITRATE, sleep_after_open=0
        )
        self._nodes: list[Any] = [BaseNode402(node, _objects()) for node in NODES]  # type: ignore[no-untyped-call]
        for node in self._nodes:
            self._network.add_node(node)
            # slcan falls behind where others keep the machine busy, and the set-up is not measured.
            node.sdo.RESPONSE_TIMEOUT = _SET_UP_PATIENCE
        _map_pdos(lambda n, *entry: self._network[n].sdo.download(entry[0], entry[1], entry[2]))
        for node in self._nodes:
            # It wants to know the network state first.
            node.sdo.download(0x1017, 0, (50).to_bytes(2, "little"))
            node.nmt.wait_for_heartbeat()
            node.setup_402_state_machine()
        self._network.nmt.send_command(1)
        for node in self._nodes:
            node.op_mode = "CYCLIC SYNCHRONOUS POSITION"
            for word in (0x06, 0x07, 0x0F):
                node.controlword = word
        time.sleep(PERIOD)

    def cycle(self, number: int) -> None:
        """Set both targets, send them and SYNC, wait for both positions."""
        for node, counts in zip(self._nodes, COUNTS_PER_CYCLE, strict=True):
            node.rpdo[2]["Target position"].raw = (number + 1) * counts
            node.rpdo[2].transmit()
        self._network.sync.transmit()
        for node in self._nodes:
            node.tpdo[2].wait_for_reception(PERIOD / 2)

    def close(self) -> None:
        """Switch off."""
        self._network.disconnect()


WAYS: dict[str, tuple[str, Callable[[str], Client]]] = {
    "driver": ("device_driver", Driver),
    "slcan": ("python-can slcan", PlainSlcan),
    "node402": ("canopen BaseNode402", Node402),
}


def ways(cycles: int = CYCLES) -> list[Way]:
    """Measure every way, in turns."""
    delays: dict[str, list[float]] = {key: [] for key in WAYS}
    shares: dict[str, list[float]] = {key: [] for key in WAYS}
    for _ in range(TURNS):
        for key, (_, client) in WAYS.items():
            delay, share = measure(client, cycles)
            delays[key].append(float(np.percentile(delay, 99)))
            shares[key].append(share)
    # The turn that the rest of the machine disturbed least.
    return [
        Way(key, what, 1e3 * min(delays[key]), 100.0 * min(shares[key]))
        for key, (what, _) in WAYS.items()
    ]


def measure(make: Callable[[str], Client], cycles: int) -> tuple[list[float], float]:
    """Run a way for some cycles.

    Returns
    -------
    delays : list of float
        From the moment of a cycle's set-points to the SYNC at the drives [s].
    share : float
        Of one core that this process took.
    """
    with tempfile.TemporaryDirectory(prefix="needle_bench_") as folder:
        channel = Path(folder) / "can"
        with subprocess.Popen(
            [sys.executable, __file__, str(channel)],
            env={**os.environ},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        ) as drives:
            assert drives.stdout is not None
            drives.stdout.readline()
            client = make(str(channel))
            begun: list[float] = []
            worked, start = time.process_time(), time.monotonic()
            for number in range(cycles):
                due = start + number * PERIOD
                time.sleep(max(due - time.monotonic(), 0.0))
                begun.append(time.monotonic())
                client.cycle(number)
            share = (time.process_time() - worked) / (time.monotonic() - start)
            client.close()
            arrived = json.loads(drives.communicate("\n")[0])
    # The first SYNC at or after a cycle's begin is its own.
    after = np.searchsorted(arrived, begun)
    return [arrived[k] - at for k, at in zip(after, begun, strict=True) if k < len(arrived)], share


def serve(channel: str) -> None:
    """Run the drives until a line comes, then print when each SYNC arrived."""
    values = DriveEmulatorParameters(boot_time=0.0)
    now = time.monotonic()
    bus = EmulatedBus(values.insertion, values.rotation, now)
    bus.poll(now)
    port = PtyPort(Path(channel))
    print("ready", flush=True)
    ended = threading.Event()

    def wait_for_line() -> None:
        sys.stdin.readline()
        ended.set()

    threading.Thread(target=wait_for_line, daemon=True).start()
    arrived: list[float] = []
    while not ended.is_set():
        select.select(port.filenos, [], [], 0.005)
        for frame in port.receive():
            bus.receive(frame, time.monotonic())
        port.send(bus.poll(time.monotonic()))
        while len(arrived) < bus.syncs:
            arrived.append(time.monotonic())
    port.unplug()
    print(json.dumps(arrived))


def _map_pdos(write: Callable[[int, int, int, bytes], Any]) -> None:
    """Map what the driver maps: command at once, target and position with SYNC."""
    maps: Sequence[tuple[int, int, int, Sequence[int], int]] = (
        (0x1400, 0x1600, 0x200, (0x60400010, 0x60600008), 255),
        (0x1401, 0x1601, 0x300, (0x607A0020,), 1),
        (0x1800, 0x1A00, 0x180, (0x60410010, 0x60610008), 1),
        (0x1801, 0x1A01, 0x280, (0x60640020,), 1),
    )
    for node in NODES:
        for parameters, mapping, cob_id, entries, kind in maps:
            write(node, parameters, 1, (1 << 31 | cob_id + node).to_bytes(4, "little"))
            write(node, mapping, 0, b"\0")
            for number, entry in enumerate(entries):
                write(node, mapping, number + 1, entry.to_bytes(4, "little"))
            write(node, mapping, 0, bytes([len(entries)]))
            write(node, parameters, 2, bytes([kind]))
            write(node, parameters, 1, (cob_id + node).to_bytes(4, "little"))


def _objects() -> canopen.ObjectDictionary:
    """Return the objects that BaseNode402 and the PDOs name."""
    objects = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
    for name, index, kind in (
        ("Controlword", 0x6040, UNSIGNED16),
        ("Statusword", 0x6041, UNSIGNED16),
        ("Modes of operation", 0x6060, INTEGER8),
        ("Modes of operation display", 0x6061, INTEGER8),
        ("Position actual value", 0x6064, INTEGER32),
        ("Target position", 0x607A, INTEGER32),
        ("Supported drive modes", 0x6502, UNSIGNED32),
    ):
        objects.add_object(_variable(name, index, 0, kind))
    for base in (0x1400, 0x1401, 0x1800, 0x1801):
        parameters = ODRecord(f"PDO {base:04X}", base)
        for number, kind in enumerate((UNSIGNED8, UNSIGNED32, UNSIGNED8)):
            parameters.add_member(_variable(f"{number}", base, number, kind))
        mapping = ODRecord(f"PDO {base + 0x200:04X}", base + 0x200)
        mapping.add_member(_variable("count", base + 0x200, 0, UNSIGNED8))
        for number in range(1, 9):
            mapping.add_member(_variable(f"{number}", base + 0x200, number, UNSIGNED32))
        objects.add_object(parameters)
        objects.add_object(mapping)
    return objects


def _variable(name: str, index: int, subindex: int, kind: int) -> ODVariable:
    variable = ODVariable(name, index, subindex)
    variable.data_type = kind
    return variable


if __name__ == "__main__":
    serve(sys.argv[1])
