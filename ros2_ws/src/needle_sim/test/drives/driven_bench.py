"""The real driver and supervisor on emulated drives, in a time of the test's own."""

from __future__ import annotations

import contextlib
import itertools
import random
from collections.abc import Callable
from typing import Any

from needle_core.messages import HoldState
from needle_core.status_messages import DeviceStatus
from needle_device_driver.axes.axis import AxisError
from needle_device_driver.cia402.cia402_axis import Cia402Axis
from needle_device_driver.cia402.drive_cycle import DriveCycle
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.link_settings import LinkSettings
from needle_device_driver.parameters import DeviceDriverParameters
from needle_device_driver.procedure import Procedure, T, run
from needle_device_driver.supervisor.command import Command, CommandPoint
from needle_device_driver.supervisor.reports import Event, Notice
from needle_device_driver.supervisor.states import State
from needle_device_driver.supervisor.supervisor import MotionSupervisor
from needle_sim.drive_emulator_parameters import DriveEmulatorParameters
from needle_sim.drives.emulated_bus import EmulatedBus

PERIOD, TICK, FRAME = 0.02, 0.001, 0.0002
UNITS = (0x608F, 0x60A8, 0x60A9, 0x60AA)


class _Link(FrameLink):
    """The driver's link in the bench's time: what the drives say is dealt with at once."""

    def __init__(self, settings: LinkSettings, bench: DrivenBench) -> None:
        self._bench = bench
        super().__init__(settings)

    @property
    def now(self) -> float:
        return self._bench.now

    @now.setter
    def now(self, value: float) -> None:
        """Be what a component sets."""

    def send(self, cob_id: int, data: bytes = b"") -> None:
        super().send(cob_id, data)
        for frame in self.take_sent():
            self._bench.bus.receive(frame, self._bench.now)
        self._bench.pass_time(FRAME)


class DrivenBench:
    """Both emulated drives, whose motors move as time goes by, and what steers them."""

    def __init__(
        self, drives: dict[str, Any] | None = None, *, tells_units: bool = True, **driver: Any
    ) -> None:
        emulator = DriveEmulatorParameters(**(drives or {}))
        self.now = 1000.0
        self.link: _Link | None = None
        self.bus = EmulatedBus(emulator.insertion, emulator.rotation, self.now)
        if not tells_units:
            for drive in self.bus.drives.values():
                objects = drive._objects
                for key in [key for key in objects._entries if key[0] in UNITS]:
                    del objects._entries[key]
                objects._indices.difference_update(UNITS)
        self.pass_time(1.0)
        settings = DeviceDriverParameters(link="virtual", channel="test", **driver)
        self.link = _Link(settings.link_settings, self)
        axes = [
            Cia402Axis(
                name,
                settings.drive(name),
                self.link,
                period=PERIOD,
                watchdog=settings.watchdog,
            )
            for name in ("insertion", "rotation")
        ]
        self.cycles = DriveCycle(self.link, axes)
        self.supervisor = MotionSupervisor(
            axes[0],
            axes[1],
            settings.limits,
            feedback_delay=1,
            switching=lambda: self.cycles.needs_cycles,
        )
        self.ros_ns = 1_000_000_000
        self.due = self.now
        self.stamps = itertools.count(1)
        self.late: Callable[[], float] = lambda: 0.0
        self._events: list[Event] = []

    def run(self, procedure: Procedure[T]) -> T:
        """Run a procedure to its end, while time goes by."""
        return run(procedure, self._wait, lambda: self.now)

    def _wait(self, is_there: Callable[[], bool], seconds: float) -> None:
        until = self.now + seconds
        while not is_there() and self.now < until:
            self.pass_time(TICK)

    def pass_time(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end - 1e-9:
            self.now = min(self.now + TICK, end)
            frames = self.bus.poll(self.now)
            if self.link is not None:
                self.link.receive(frames)

    @property
    def status(self) -> DeviceStatus:
        return self.supervisor.status(self.now)

    @property
    def notices(self) -> list[Notice]:
        self._events += self.supervisor.take_events()
        return [event for event in self._events if isinstance(event, Notice)]

    @property
    def insertion_mm(self) -> float:
        return self.bus.axes(self.now)["insertion"].position * 1e3

    def cycle(self, count: int = 1, *, hold: float | None = None) -> None:
        """Run cycles, each so late as `late` says; `hold` is a speed scale."""
        for _ in range(count):
            self.due = max(self.due + PERIOD, self.now) + self.late()
            self.pass_time(self.due - self.now)
            self.ros_ns += 20_000_000
            if hold is not None:
                self.hold(True, hold)
            self.supervisor.note_time(self.ros_ns, self.now)
            self.cycles.collect()
            self.supervisor.drive(PERIOD, self.now)
            self.run(self.cycles.exchange(0.75 * PERIOD))
            self.supervisor.observe(self.now)

    def hold(self, pressed: bool, scale: float = 1.0) -> None:
        message = HoldState("a", "", next(self.stamps), pressed, scale)
        self.supervisor.receive_hold(message, self.now)

    def home(self, most: int = 20_000) -> None:
        """Configure and home; return when that has ended, however."""
        reply = self.run(self.supervisor.configure(self.now))
        assert reply.success, reply.message
        self.due = self.now
        self.cycle(2)
        self.supervisor.confirm_needle_out(True)
        reply = self.run(self.supervisor.home(self.now))
        assert reply.success, reply.message
        for _ in range(most):
            self.cycle(1)
            if self.supervisor.state is not State.MOVING:
                return
        raise AssertionError(f"still homing at {self.insertion_mm:.2f} mm")

    def enable(self) -> None:
        for _ in range(100):
            self.cycle(1)
            if self.supervisor.enable(True, self.now).success:
                break
        self.cycle(20)
        self.hold(False)
        self.hold(True)

    def step(self, length: float, rotation: float, duration: float) -> None:
        at = self.supervisor.joints(self.now)
        assert at is not None
        point = CommandPoint(
            (at.insertion.position + length, at.rotation.position + rotation), (), duration
        )
        names = ("insertion_joint", "rotation_joint")
        self.supervisor.submit(Command(self.ros_ns, names, (point,)), self.now)

    def wander(self, rng: random.Random, steps: int) -> None:
        """Take steps at all speeds, some of them broken off, some paused."""
        for _ in range(steps):
            duration = rng.choice((0.2, 0.4, 1.0))
            self.step(0.001, rng.uniform(-0.6, 0.6), duration)
            for _ in range(rng.randrange(20, 80)):
                self.cycle(1, hold=rng.choice((1.0, 1.0, 0.5, 0.01)))
            if rng.random() < 0.3:
                self.hold(False)
                self.cycle(rng.randrange(20))
                self.hold(False)
                self.hold(True)

    def close(self) -> None:
        with contextlib.suppress(AxisError):
            self.run(self.supervisor.deconfigure())
        assert self.link is not None
        self.link.close()
