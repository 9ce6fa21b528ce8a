"""A master for the emulated drives: PyPI canopen on a bus without threads and delays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import canopen

from needle_core.can_frame import CanFrame
from needle_sim.drives.cia402 import SERVO, STEPPER, EmulatedDriveSettings
from needle_sim.drives.emulated_bus import EmulatedBus
from needle_sim.drives.motor import MotorSettings

INSERTION, ROTATION, MASTER = 1, 2, 127
CSP, PP, HM = 8, 1, 6  # modes of operation
COUNTS_PER_METRE = 2.0e7
COUNTS_PER_RADIAN = 65536 / math.tau
SYNC_PERIOD = 0.02


def settings(name: str, *, start: float = 0.0, lag: float = 0.0) -> Any:
    if name == "insertion":
        scale = COUNTS_PER_METRE
        motor = MotorSettings(scale, 0.01 * scale, lag, start, 0.25 * scale)
        return EmulatedDriveSettings(name, INSERTION, STEPPER, motor, 0.3)
    motor = MotorSettings(COUNTS_PER_RADIAN, 20.0 * COUNTS_PER_RADIAN, lag)
    return EmulatedDriveSettings(name, ROTATION, SERVO, motor, 0.3)


class Master:
    """Both drives, booted and OPERATIONAL, and the frames received from them."""

    def __init__(self, **motor: float) -> None:
        self.bus = EmulatedBus((settings("insertion", **motor), settings("rotation")), 0.0)
        self.now = 0.0
        self.received: list[CanFrame] = []
        self.network = canopen.Network()
        self.network.bus = self  # type: ignore[assignment]  # all of a bus that canopen uses
        self.nodes = {n: self.network.add_node(n, None) for n in (INSERTION, ROTATION)}
        self.wait(0.31)
        self.network.nmt.send_command(1)

    # ---- as a bus of python-can ---------------------------------------------------------------

    def send(self, message: Any, timeout: float | None = None) -> None:
        data = bytes(message.data)
        frame = CanFrame(message.arbitration_id, data, bool(message.is_remote_frame))
        self._receive(self.bus.receive((frame,), self.now))
        self._receive(self.bus.poll(self.now))

    def shutdown(self) -> None:
        """Nothing to shut down."""

    def _receive(self, frames: Sequence[CanFrame]) -> None:
        for frame in frames:
            self.received.append(frame)
            self.network.notify(frame.identifier, bytearray(frame.data), self.now)

    # ---- interface for tests ------------------------------------------------------------------

    def wait(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end - 1e-9:
            self.now = min(self.now + 0.001, end)
            self._receive(self.bus.poll(self.now))

    def frames(self, identifier: int) -> list[bytes]:
        return [frame.data for frame in self.received if frame.identifier == identifier]

    def read(self, index: int, subindex: int = 0, node: int = INSERTION) -> int:
        data = self.nodes[node].sdo.upload(index, subindex)
        signed = index in (0x6064, 0x6062, 0x60F4, 0x606C, 0x6061, 0x6077)
        return int.from_bytes(data, "little", signed=signed)

    def write(
        self, index: int, subindex: int, value: int, size: int, node: int = INSERTION
    ) -> None:
        data = value.to_bytes(size, "little", signed=value < 0)
        self.nodes[node].sdo.download(index, subindex, data)

    def control(self, *words: int, node: int = INSERTION) -> None:
        for word in words:
            self.write(0x6040, 0, word, 2, node)

    def enable(self, mode: int, node: int = INSERTION) -> None:
        self.write(0x6060, 0, mode, 1, node)
        self.write(0x607A, 0, self.read(0x6064, node=node), 4, node)
        self.control(0x06, 0x07, 0x0F, node=node)

    def target(self, counts: int, node: int = INSERTION) -> None:
        self.write(0x607A, 0, counts, 4, node)

    def sync(self, count: int = 1) -> None:
        for _ in range(count):
            self.now += SYNC_PERIOD
            self.network.send_message(0x80, b"")

    def home(self, method: int = 17, node: int = INSERTION) -> int:
        """Home with 2 mm/s, 0.2 mm/s off the switch; return how many SYNCs it took."""
        self.write(0x6098, 0, method, 1, node)
        self.write(0x6099, 1, 40_000, 4, node)
        self.write(0x6099, 2, 4_000, 4, node)
        self.write(0x609A, 0, 1_000_000, 4, node)
        self.enable(6, node)
        self.control(0x1F, node=node)
        for count in range(5000):
            if self.status(node) & 0x1400 == 0x1400:
                return count
            self.sync()
        raise AssertionError(f"not homed: {self.status(node):04X}")

    def status(self, node: int = INSERTION) -> int:
        return self.read(0x6041, node=node)

    def state(self, node: int = INSERTION) -> int:
        return self.status(node) & 0x6F

    def true_counts(self, axis: str = "insertion") -> float:
        return self.bus.drives[axis].motor.position
