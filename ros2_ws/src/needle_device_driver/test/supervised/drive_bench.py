"""A supervisor on two scripted drives behind a CAN bus."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable
from typing import Any

from needle_core.can_frame import CanFrame
from needle_core.messages import HoldState
from needle_core.status_messages import DeviceStatus
from needle_device_driver.axes.axis import AxisError
from needle_device_driver.cia402.cia402_axis import Cia402Axis
from needle_device_driver.cia402.drive_cycle import DriveCycle
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.link_settings import LinkSettings
from needle_device_driver.parameters import DeviceDriverParameters
from needle_device_driver.procedure import Procedure, T, run
from needle_device_driver.supervisor.reports import Event, Notice, StepResult
from needle_device_driver.supervisor.states import State
from needle_device_driver.supervisor.supervisor import MotionSupervisor

from .ideal_axes import PERIOD, Bench
from .scripted_drives import ScriptedBus, ScriptedDrive

# On the bus [s].
FRAME_TIME = 0.0005


class BenchLink(FrameLink):
    """A link in the bench's time, whose frames are answered while they are sent."""

    def __init__(self, settings: LinkSettings, bench: DriveBench) -> None:
        self._bench = bench
        super().__init__(settings)

    @property
    def now(self) -> float:
        return self._bench.now

    @now.setter
    def now(self, value: float) -> None:
        """Be what a component sets."""

    def open(self) -> None:
        if not self.is_open:
            self.change("no such file" if self._bench.no_adapter else "")
            super().open()
            self._bench.open(lambda frame: self.receive([frame]))

    def send(self, cob_id: int, data: bytes = b"") -> None:
        super().send(cob_id, data)
        self.take_sent()
        if self._bench.broken:
            self.change(self._bench.broken)
        else:
            self._bench.bus.send(cob_id, data)


class DriveBench:
    """Driver and supervisor on two scripted drives, cycle by cycle, in a time of their own."""

    period = PERIOD
    command = staticmethod(Bench.step_command)

    def __init__(self, **parameters: Any) -> None:
        self.insertion, self.rotation = ScriptedDrive(1), ScriptedDrive(2)
        self.now = 1000.0
        self.buses: list[ScriptedBus] = []
        self.no_adapter = False
        # What the adapter does not send for; empty: it sends.
        self.broken = ""
        self.settings = DeviceDriverParameters(link="virtual", channel="test", **parameters)
        self.link = BenchLink(self.settings.link_settings, self)
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

    def clock(self) -> float:
        return self.now

    def pass_frame(self) -> None:
        self.now += FRAME_TIME

    def open(self, receive: Callable[[CanFrame], None]) -> None:
        self.broken = ""
        self.buses.append(ScriptedBus([self.insertion, self.rotation], receive, self.pass_frame))

    def run(self, procedure: Procedure[T]) -> T:
        """Run a procedure to its end: what is not there, nobody brings, and the time passes."""

        def wait(is_there: Callable[[], bool], seconds: float) -> None:
            if not is_there():
                self.now += seconds

        return run(procedure, wait, self.clock)

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
            self.now += PERIOD
            if holding:
                self.hold(scale=scale)
            self.supervisor.note_time(self.ros_ns, self.now)
            self.drives.collect()
            self.supervisor.drive(PERIOD, self.now)
            # What is answered at once is here when the frame is sent.
            self.run(self.drives.exchange(0.0))
            self.supervisor.observe(self.clock())

    def hold(self, pressed: bool = True, *, scale: float = 1.0) -> None:
        message = HoldState("a", "", next(self.stamps), pressed, scale)
        self.supervisor.receive_hold(message, self.clock())

    def written(self, node: int, index: int, subindex: int = 0) -> bytes:
        """Return what a drive's object holds after set-up."""
        drive = self.insertion if node == self.insertion.node else self.rotation
        return drive.objects[index, subindex]

    def configured(self) -> None:
        assert self.run(self.supervisor.configure(self.clock())).success
        self.cycle(2)

    def homed(self) -> None:
        self.configured()
        self.supervisor.confirm_needle_out(True)
        assert self.run(self.supervisor.home(self.clock())).success
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
                joints.insertion.position + length,
                joints.rotation.position + rotation,
                self.ros_ns,
                duration,
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
            self.run(self.supervisor.deconfigure())
        self.link.close()
