"""Driver, emulated drives and somebody who gives orders, on a virtual runner."""

from __future__ import annotations

import random
from typing import Any

from needle_core.can_frame import CAN, CanFrame
from needle_core.runners.faults import Arrival, Arrivals, Fault, Link
from needle_device_driver.device_driver import DeviceDriver
from needle_device_driver.parameters import DeviceDriverParameters
from needle_sim.drive_emulator import DriveEmulator
from needle_sim.drive_emulator_parameters import DriveEmulatorParameters

from .person import VirtualBench

_ALL = range(0x800)
DRIVER, DRIVES = DeviceDriver.name, DriveEmulator.name


class ComponentBench(VirtualBench):
    """The three, and every frame between driver and drives."""

    def __init__(
        self, *, fault: Fault | None = None, drives: dict[str, Any] | None = None, **driver: Any
    ) -> None:
        self.drives = DriveEmulator(DriveEmulatorParameters(**(drives or {})))
        self.driver = DeviceDriver(DeviceDriverParameters(link="virtual", channel=CAN, **driver))
        self.frames: list[tuple[float, str, CanFrame]] = []
        self.marked = 0.0
        faults = (self._note, *(() if fault is None else (fault,)))
        super().__init__(self.drives, self.driver, faults=faults)

    def _note(self, link: Link, message: Any, now: float, rng: random.Random) -> Arrivals:
        if link.topic == CAN:
            self.frames += [(now, link.sender, frame) for frame in message]
        return (Arrival(0.0, message),)

    @property
    def places(self) -> tuple[float, float]:
        """Where the motors really are [m], [rad]."""
        axes = self.drives.bus.axes(self.runner.now)
        return axes["insertion"].position, axes["rotation"].position

    @property
    def error_codes(self) -> set[int]:
        return {drive.error_code for drive in self.drives.bus.drives.values()}

    def sent(self, *cob_ids: int, by: str = DRIVER) -> list[tuple[float, CanFrame]]:
        """Return frames of these COB-IDs since the mark, with their times."""
        return [
            (time, frame)
            for time, sender, frame in self.frames
            if time >= self.marked and sender == by and frame.identifier in (cob_ids or _ALL)
        ]

    @staticmethod
    def entry(frame: CanFrame) -> tuple[int, int]:
        """Return the index and subindex that an SDO frame is about."""
        return int.from_bytes(frame.data[1:3], "little"), frame.data[3]

    def mark(self) -> None:
        self.marked = self.runner.now

    def set_up(self) -> None:
        self.until(lambda: self.status.state == "DISABLED")
        self.succeed("confirm_needle_out", True)

    def home(self) -> None:
        self.set_up()
        assert self.call("home").success

    def arm(self) -> None:
        """Enable once it is homed, and press the hold."""
        self.until(lambda: self.status.homed)
        self.succeed("enable", True)
        self.run(0.3)
        self.person.pressed = True
        self.run(0.1)

    def moving(self) -> None:
        """Be in the middle of a step."""
        if not self.person.pressed:
            self.home()
            self.arm()
        begin = self.places[0]
        self.command(0.002, 0.5, 1.0)
        self.until(lambda: self.places[0] > begin + 0.0005)

    def release(self) -> None:
        self.until(lambda: self.status.state == "FAULT", 2.0)
        self.person.pressed = False
        self.run(0.5)

    def rests(self, seconds: float = 0.5) -> bool:
        """Tell whether neither motor moves for some time."""
        at = self.places
        self.run(seconds)
        return self.places == at


def losing(identifier: int, until: list[float]) -> Fault:
    """Return a fault that loses frames of an identifier shortly before a time that is set later."""

    def fault(link: Link, message: Any, now: float, rng: random.Random) -> Arrivals:
        if link.topic == CAN and until[0] - 0.3 <= now < until[0]:
            message = tuple(frame for frame in message if frame.identifier != identifier)
        return (Arrival(0.0, message),)

    return fault
