"""Drives that answer at once, and a supervisor on them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

from needle_device_driver.axes.capabilities import Capabilities
from needle_device_driver.parameters import DeviceDriverParameters
from needle_device_driver.polled.drive_protocol import DriveProtocol, DriveReply
from needle_device_driver.polled.polled_drives import PolledDrives
from needle_device_driver.polled.text_link import TextLink
from needle_device_driver.procedure import Procedure, T, run
from needle_device_driver.supervisor.supervisor import MotionSupervisor

from ..supervisor_bench import PERIOD, SupervisorBench


@dataclasses.dataclass
class Drive:
    position: int = 0
    # Edge of the outer limit switch [counts].
    edge: int = 0
    powered: bool = False
    target: int = 0
    blocked: bool = False
    deaf: bool = False
    rebooted: bool = False
    fault: str = ""

    def move(self) -> bool:
        """Move to the target; return whether it moved."""
        if self.blocked or not self.powered or self.position == self.target:
            return False
        self.position = self.target
        return True


class IdealProtocol(DriveProtocol):
    capabilities = Capabilities(
        streams=True,
        watchdog=math.inf,
        longest_order=PERIOD,
        response_time=PERIOD,
        encoder=True,
        switches=True,
        limits=True,
        identity=True,
        exclusive=False,
    )

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.drives = {axis: Drive() for axis in self.axes}
        self.limits: dict[str, tuple[int, int]] = {}
        self.is_silent = self.is_late = False
        self._late: list[tuple[float, int, dict[str, DriveReply]]] = []

    def identify(self) -> Procedure[str]:
        yield from ()
        return "Emulated ideal"

    def set_up(self, axis: str) -> Procedure[None]:
        self.drives[axis].rebooted = self.drives[axis].powered = False
        yield from ()

    def clear_fault(self, axis: str) -> Procedure[None]:
        self.drives[axis].fault = ""
        yield from ()

    def write_limits(self, axis: str, lower: int, upper: int) -> Procedure[None]:
        self.limits[axis] = lower, upper
        yield from ()

    def release(self, axis: str) -> Procedure[None]:
        self.drives[axis].powered = False
        yield from ()

    def power(self, axis: str, on: bool) -> None:
        drive = self.drives[axis]
        if not drive.deaf:
            drive.powered, drive.target = on, drive.position

    def move_to(self, axis: str, position: int, speed: int) -> None:
        self.drives[axis].target = position

    def stop(self, axis: str) -> None:
        drive = self.drives[axis]
        if not drive.deaf:
            drive.target = drive.position

    def deliver_late_answers(self) -> None:
        while self._late and self._late[0][0] <= self.link.now:
            self.on_status(*self._late.pop(0)[1:])

    def request(self, number: int) -> None:
        if self.is_silent:
            return
        states = {}
        for axis, drive in self.drives.items():
            moving = drive.move()
            edge = drive.edge if axis == "insertion" else -math.inf
            states[axis] = DriveReply(
                drive.position,
                moving,
                drive.powered,
                home_switch=drive.position < edge,
                fault=drive.fault,
                rebooted=drive.rebooted,
            )
        if self.is_late:
            self._late.append((self.link.now + 0.03, number, states))
        else:
            self.on_status(number, states)

    def on_line(self, line: str) -> None:
        """Do nothing: this protocol has no lines."""


class PolledBench(SupervisorBench):
    """Supervisor on ideal drives, with virtual time."""

    def __init__(self, **parameters: Any) -> None:
        super().__init__()
        self.settings = DeviceDriverParameters(**parameters)
        self.link = TextLink("ideal", b"\n")
        axes = {name: self.settings.axis(name) for name in ("insertion", "rotation")}
        self.protocol = IdealProtocol(self.settings, axes, self.link)
        self.drives = PolledDrives("ideal", self.protocol)
        self.insertion = self.protocol.drives["insertion"]
        self.rotation = self.protocol.drives["rotation"]
        self.supervisor = MotionSupervisor(
            self.drives.axes["insertion"],
            self.drives.axes["rotation"],
            self.settings,
            feedback_delay=1,
            is_switching=lambda: self.drives.needs_cycles,
        )
        self.link.now = self.now
        assert not self.run(self.drives.probe())

    def run(self, procedure: Procedure[T]) -> T:
        def wait(is_there: Callable[[], bool], seconds: float) -> None:
            self.now += 0.0 if is_there() else seconds
            self.link.now = self.now

        return run(procedure, wait, lambda: self.now)

    def exchange(self) -> None:
        self.link.now = self.now
        self.protocol.deliver_late_answers()
        self.supervisor.drive(PERIOD, self.now)
        self.run(self.drives.exchange(0.0))
        self.supervisor.observe(self.now)

    def ready(self, start_mm: float = 3.0) -> PolledBench:
        """Home from a distance to the switch, enable and press the hold."""
        self.insertion.position = self.insertion.target = round(start_mm * 20_000) + 1_000_000
        self.insertion.edge = 1_000_000
        assert self.configure().success
        self.wait(2)
        assert self.home().success
        self.wait(700)
        assert self.is_homed(), self.status
        assert self.enable().success
        self.wait(3)
        self.press()
        self.go()
        return self

    def step(self, length: float = 0.001, rotation: float = 0.1, duration: float = 0.5) -> None:
        joints = self.supervisor.joints(self.now)
        assert joints is not None
        at = joints.insertion.position, joints.rotation.position
        self.submit((at[0] + length, at[1] + rotation, duration))
