"""The driver's 50 Hz cycle compared with stock python-can, on the same emulated drives.

Each client moves both axes over a pseudo-terminal; the process of the drives records when each SYNC
arrives.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import can
import numpy as np

from campaign.benchmarks.figure_rows import Row
from needle_core.component import PortChange
from needle_device_driver.cia402.backend import Cia402Drives, drive_settings
from needle_device_driver.cia402.cia402_axis import Cia402Axis
from needle_device_driver.link.can_port import Batch, CanPort, LinkSettings
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.parameters import DeviceDriverParameters
from needle_device_driver.procedure import Procedure, T, run
from needle_sim.bus.pty_can import PtyCan
from needle_sim.drive_emulator import AXES, DriveEmulatorParameters
from needle_sim.drives.emulated_bus import EmulatedBus

PERIOD = 0.02
CYCLES = 250
TURNS = 3
NODES = (1, 2)
BITRATE = 500_000
# 2 mm/s and 1 rad/s.
COUNTS_PER_CYCLE = (800, 209)


class Driver:
    """Client that runs the cycle of needle_device_driver, without supervisor and ROS."""

    def __init__(self, channel: str) -> None:
        values = DeviceDriverParameters()
        settings = LinkSettings("slcan", channel, BITRATE)
        self._link = FrameLink(settings.link_name)
        self._arrived: queue.SimpleQueue[Batch | PortChange] = queue.SimpleQueue()
        self._port = CanPort(settings)
        self._port.open(self._arrived.put)
        self._axes = [
            Cia402Axis(name, drive_settings(values, name), self._link, watchdog=0.5)
            for name in ("insertion", "rotation")
        ]
        self._cycle = Cia402Drives(self._link, self._axes, 0.5)
        for axis in self._axes:
            self._run(axis.configure())
            axis.power(True)
        while not all(axis.poll(0.0).powered for axis in self._axes):
            self._run(self._cycle.exchange(PERIOD / 2))
            time.sleep(PERIOD)
        self._starts = [axis.poll(0.0).position for axis in self._axes]
        self._units = [values.axis(axis.name).counts_per_unit for axis in self._axes]

    def cycle(self, number: int) -> None:
        """Run one cycle like the node."""
        for axis, start, counts, unit in zip(
            self._axes, self._starts, COUNTS_PER_CYCLE, self._units, strict=True
        ):
            axis.start_move(start + (number + 1) * counts / unit, counts / unit / PERIOD)
        self._run(self._cycle.exchange(PERIOD / 2))

    def close(self) -> None:
        """Switch the drives off, and close the port."""
        for axis in self._axes:
            self._run(axis.close())
        self._port.close()

    def _run(self, procedure: Procedure[T]) -> T:
        return run(procedure, self._wait, self._now)

    def _now(self) -> float:
        self._link.now = time.monotonic()
        return self._link.now

    def _wait(self, is_there: Callable[[], bool], seconds: float) -> None:
        """Send queued frames, and receive until the condition holds."""
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
    """Client that uses python-can's slcan bus, with its Notifier for the answers."""

    def __init__(self, channel: str) -> None:
        self._bus = can.Bus(interface="slcan", channel=channel, bitrate=BITRATE, sleep_after_open=0)
        self._answers = threading.Semaphore(0)
        self._notifier = can.Notifier(self._bus, [self._receive])
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
        """Close the bus."""
        self._notifier.stop()
        self._bus.shutdown()

    def _receive(self, message: can.Message) -> None:
        if message.arbitration_id & ~0x7F == 0x280:
            self._answers.release()

    def _sdo(self, node: int, index: int, subindex: int, data: bytes) -> None:
        head = bytes([0x23 | (4 - len(data)) << 2]) + index.to_bytes(2, "little")
        self._send(0x600 + node, head + bytes([subindex]) + data.ljust(4, b"\0"))
        time.sleep(0.002)

    def _send(self, identifier: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))


Client = Driver | PlainSlcan
CLIENTS: dict[str, Callable[[str], Client]] = {
    "device_driver": Driver,
    "python-can slcan": PlainSlcan,
}


def rows(cycles: int = CYCLES) -> Iterator[Row]:
    """Yield delay and CPU share of the driver's 50 Hz cycle, compared with python-can's slcan."""
    figures: dict[str, list[tuple[float, float]]] = {name: [] for name in CLIENTS}
    # The clients take turns, so that other load on the machine affects both.
    for _ in range(TURNS):
        for name, client in CLIENTS.items():
            delays, share = measure(client, cycles)
            figures[name].append((1e3 * float(np.percentile(delays, 99)), 100.0 * share))
    # The minimum over the turns is the one least disturbed by other load.
    (_, driver), (against, reference) = (
        (name, np.min(values, axis=0).tolist()) for name, values in figures.items()
    )
    what = "50 Hz cycle, p99 until SYNC is out"
    yield Row("drives_delay_p99", what, "ms", driver[0], against, reference[0])
    yield Row("drives_cpu", "50 Hz cycle, share of a core", "%", driver[1], against, reference[1])


def measure(make: Callable[[str], Client], cycles: int) -> tuple[list[float], float]:
    """Run a client for some cycles.

    Returns
    -------
    delays : list of float
        Time from the set-points of a cycle to the SYNC at the drives [s].
    share : float
        CPU time of this process as a share of one core.
    """
    with tempfile.TemporaryDirectory(prefix="needle_bench_") as folder:
        channel = Path(folder) / "can"
        with subprocess.Popen(
            [sys.executable, __file__, str(channel)],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
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
    # The first SYNC at or after the start of a cycle belongs to it.
    after = np.searchsorted(arrived, begun)
    return [arrived[k] - at for k, at in zip(after, begun, strict=True) if k < len(arrived)], share


def serve(channel: str) -> None:
    """Run the drives until a line arrives on stdin, then print the arrival time of each SYNC."""
    values = DriveEmulatorParameters(boot_time=0.0)
    now = time.monotonic()
    bus = EmulatedBus(map(values.cia402, AXES), now)
    bus.poll(now)
    port = PtyCan(Path(channel))
    print("ready", flush=True)
    ended = threading.Event()

    def wait_for_line() -> None:
        sys.stdin.readline()
        ended.set()

    threading.Thread(target=wait_for_line, daemon=True).start()
    arrived: list[float] = []
    while not ended.is_set():
        port.wait(0.005)
        port.send(bus.receive(port.receive(), time.monotonic()))
        port.send(bus.poll(time.monotonic()))
        while len(arrived) < bus.syncs:
            arrived.append(time.monotonic())
    port.close()
    print(json.dumps(arrived))


def _map_pdos(write: Callable[[int, int, int, bytes], Any]) -> None:
    """Map the PDOs like the driver: controlword at once, target and position with SYNC."""
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


if __name__ == "__main__":
    serve(sys.argv[1])
