"""A supervisor on two scripted drives behind a CAN bus."""

from __future__ import annotations

import contextlib
import itertools
import time
from typing import Any

from needle_device_driver.axis import AxisError
from needle_device_driver.can_link import CanLink, LinkError
from needle_device_driver.cia402_axis import Cia402Axis
from needle_device_driver.drive_cycle import DriveCycle
from needle_device_driver.hold import HoldMessage
from needle_device_driver.parameters import DeviceDriverParameters
from needle_device_driver.reports import DeviceStatus, Event, Notice, StepResult
from needle_device_driver.states import State
from needle_device_driver.supervisor import MotionSupervisor

from .ideal_axes import PERIOD, Bench
from .scripted_drives import ScriptedBus, ScriptedDrive


class DriveBench:
    """Driver and supervisor on two scripted drives, cycle by cycle."""

    period = PERIOD
    command = staticmethod(Bench.step_command)

    def __init__(self, **parameters: Any) -> None:
        self.insertion, self.rotation = ScriptedDrive(1), ScriptedDrive(2)
        self.skipped = 0.0
        self.buses: list[ScriptedBus] = []
        self.no_adapter = False
        self.settings = DeviceDriverParameters(link="virtual", channel="test", **parameters)
        self.link = CanLink(self.settings.link_settings, self.clock, self.open)
        self.axes = [
            Cia402Axis(
                name,
                self.settings.drive(name),
                self.link,
                period=PERIOD,
                watchdog=self.settings.watchdog,
            )
            for name in ("insertion", "rotation")
        ]
        self.drives = DriveCycle(self.link, self.axes)
        self.supervisor = MotionSupervisor(
            self.axes[0],
            self.axes[1],
            self.settings.limits,
            feedback_delay=1,
            switching=lambda: self.drives.needs_cycles,
        )
        self.ros_ns = 1_000_000_000
        self.stamps = itertools.count(1)
        self.events: list[Event] = []
        self.wait = 2.0

    def clock(self) -> float:
        return time.monotonic() + self.skipped

    def open(self, settings: Any) -> Any:
        if self.no_adapter:
            raise LinkError(f"cannot open {settings}: no such file")
        self.buses.append(ScriptedBus([self.insertion, self.rotation]))
        return self.buses[-1]

    @property
    def bus(self) -> ScriptedBus:
        return self.buses[-1]

    @property
    def state(self) -> State:
        return self.supervisor.state

    @property
    def status(self) -> DeviceStatus:
        return self.supervisor.status(self.clock())

    @property
    def notices(self) -> list[Notice]:
        self.events += self.supervisor.take_events()
        return [event for event in self.events if isinstance(event, Notice)]

    @property
    def outcomes(self) -> list[str]:
        self.events += self.supervisor.take_events()
        return [event.outcome for event in self.events if isinstance(event, StepResult)]

    def cycle(self, count: int = 1, *, holding: bool = False, scale: float = 1.0) -> None:
        for _ in range(count):
            self.ros_ns += 20_000_000
            if holding:
                self.hold(scale=scale)
            now = self.clock()
            self.supervisor.note_time(self.ros_ns, now)
            self.drives.collect()
            self.supervisor.drive(PERIOD, now)
            self.drives.exchange(self.wait)
            self.supervisor.observe(self.clock())

    def hold(self, pressed: bool = True, *, scale: float = 1.0) -> None:
        message = HoldMessage("a", next(self.stamps), pressed, scale)
        self.supervisor.receive_hold(message, self.clock())

    def deliver(self, drive: ScriptedDrive) -> None:
        """Hand on what a drive said by itself, and wait until the link has taken it."""
        before = self.link.frames_received
        count = len(drive.out)
        self.bus.flush()
        with self.link.arrival:
            assert self.link.arrival.wait_for(
                lambda: self.link.frames_received >= before + count, 5.0
            )

    def written(self, node: int, index: int, subindex: int = 0) -> bytes:
        """Return what a drive's object holds after set-up."""
        drive = self.insertion if node == self.insertion.node else self.rotation
        return drive.objects[index, subindex]

    def configured(self) -> None:
        assert self.supervisor.configure(self.clock()).success
        self.cycle(2)

    def homed(self) -> None:
        self.configured()
        self.supervisor.confirm_needle_out(True)
        assert self.supervisor.home(self.clock()).success
        self.cycle(30)
        assert self.status.homed
        assert self.state is State.DISABLED

    def ready(self) -> None:
        self.homed()
        assert self.supervisor.enable(True, self.clock()).success
        self.cycle(12)
        self.hold(False)
        self.hold()

    def step(self, length: float = 0.001, rotation: float = 0.1, duration: float = 0.5) -> None:
        joints = self.supervisor.joints(self.clock())
        assert joints is not None
        self.supervisor.submit(
            Bench.step_command(
                joints.insertion + length, joints.rotation + rotation, self.ros_ns, duration
            ),
            self.clock(),
        )

    def moving(self) -> None:
        """Be in the middle of a step."""
        self.ready()
        self.cycle(1, holding=True)
        self.step(0.002, 0.2, 1.0)
        self.cycle(10, holding=True)
        assert self.state is State.MOVING
        assert self.insertion.position > 0

    @property
    def positions(self) -> tuple[int, int]:
        return self.insertion.position, self.rotation.position

    def close(self) -> None:
        with contextlib.suppress(AxisError):
            self.supervisor.close()
        self.link.close()
