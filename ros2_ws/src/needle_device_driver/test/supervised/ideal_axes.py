"""A supervisor on two ideal axes."""

from __future__ import annotations

import itertools
import math

from needle_core.messages import HoldState
from needle_core.status_messages import DeviceStatus
from needle_device_driver.axes.axis import Axis, AxisError, AxisSnapshot
from needle_device_driver.procedure import Procedure, run_at_once
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.command import Command, CommandPoint
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_device_driver.supervisor.reports import Event, Notice, StepResult
from needle_device_driver.supervisor.states import State
from needle_device_driver.supervisor.supervisor import MotionSupervisor

PERIOD = 0.02


class FakeAxis(Axis):
    """Goes where it is told; fails, lags or falls silent when told to."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.position = 0.0
        self.target: float | None = None
        self.speed = 0.0
        self.powered = False
        self.homed = False
        self.homing = False
        self.switch: bool | None = None
        self.inner_switch = False
        self.fault = ""
        self.unplugged = False
        self.silent_since: float | None = None
        self.stuck = False
        self.stops = 0
        self.orders: list[str] = []

    def _order(self, name: str) -> None:
        if self.unplugged:
            raise AxisError(f"{self.name}: no link")
        self.orders.append(name)

    def configure(self) -> Procedure[None]:
        yield from ()
        self._order("configure")

    def power(self, on: bool) -> None:
        self._order("on" if on else "off")
        self.powered, self.target, self.homing = on, None, False

    def home(self, speed: float) -> Procedure[None]:
        yield from ()
        self._order("home")
        self.homed = self.position == 0.0
        self.homing, self.target, self.speed = not self.homed, 0.0, speed

    def start_move(self, target: float, speed: float) -> None:
        self._order("move")
        self.target, self.speed = target, speed

    def stop(self) -> None:
        self._order("stop")
        self.stops += 1
        self.target, self.homing = None, False

    def reset(self) -> Procedure[None]:
        yield from ()
        self._order("reset")
        self.fault = ""

    def close(self) -> Procedure[None]:
        yield from ()
        self.powered = False

    def poll(self, now: float) -> AxisSnapshot:
        switch = self.position <= 0.0 if self.switch is None else self.switch
        return AxisSnapshot(
            time=now if self.silent_since is None else self.silent_since,
            position=self.position,
            set_point=self.position,
            velocity=0.0,
            powered=self.powered,
            homed=self.homed,
            moving=self.homing,
            at_home_switch=switch,
            at_inner_switch=self.inner_switch,
            fault=self.fault,
        )

    def advance(self, period: float) -> None:
        if self.target is None or not self.powered or self.stuck:
            return
        way = self.target - self.position
        reach = self.speed * period
        if abs(way) <= reach * (1 + 1e-9):
            self.position = self.target
            self.homed = self.homed or self.homing
            self.homing = False
        else:
            self.position += reach if way > 0 else -reach


class Bench:
    """Drives a supervisor cycle by cycle and remembers what it tells."""

    period = PERIOD
    run = staticmethod(run_at_once)

    def __init__(self, **limits: float) -> None:
        self.insertion = FakeAxis("insertion")
        self.rotation = FakeAxis("rotation")
        self.limits = SafetyLimits(**limits)
        self.supervisor = MotionSupervisor(
            self.insertion,
            self.rotation,
            self.limits,
        )
        self.now = 100.0
        self.ros_ns = 1_000_000_000
        self.stamps = itertools.count(1)
        self.events: list[Event] = []
        self.supervisor.note_time(0, self.now)
        self.supervisor.note_time(self.ros_ns, self.now)

    @property
    def state(self) -> State:
        return self.supervisor.state

    @property
    def status(self) -> DeviceStatus:
        return self.supervisor.status(self.now)

    @property
    def results(self) -> list[StepResult]:
        self._collect()
        return [event for event in self.events if isinstance(event, StepResult)]

    @property
    def notices(self) -> list[Notice]:
        self._collect()
        return [event for event in self.events if isinstance(event, Notice)]

    @property
    def last_rule(self) -> Rule | None:
        notices = self.notices
        return notices[-1].rule if notices else None

    @property
    def positions(self) -> tuple[float, float]:
        return self.insertion.position, self.rotation.position

    def _collect(self) -> None:
        self.events += self.supervisor.take_events()

    def hold(
        self,
        pressed: bool = True,
        *,
        sender: str = "a",
        scale: float = 1.0,
        session: str = "",
        count: int | None = None,
        lifetime: float = math.inf,
    ) -> None:
        number = next(self.stamps) if count is None else count
        message = HoldState(sender, session, number, pressed, scale, lifetime)
        self.supervisor.receive_hold(message, self.now)

    def cycle(self, count: int = 1, *, holding: bool = False, scale: float = 1.0) -> None:
        for _ in range(count):
            self.now += PERIOD
            self.ros_ns += 20_000_000
            if holding:
                self.hold(scale=scale)
            self.supervisor.note_time(self.ros_ns, self.now)
            self.supervisor.drive(PERIOD, self.now)
            self.insertion.advance(PERIOD)
            self.rotation.advance(PERIOD)
            self.supervisor.observe(self.now)

    def home(self) -> None:
        self.run(self.supervisor.configure(self.now))
        self.supervisor.confirm_needle_out(True)
        assert self.run(self.supervisor.home(self.now)).success

    def ready(self, *, holding: bool = True) -> None:
        self.home()
        assert self.supervisor.enable(True, self.now).success
        if holding:
            self.hold()

    @staticmethod
    def step_command(
        insertion: float, rotation: float, stamp_ns: int, duration: float = 0.5
    ) -> Command:
        return Command(
            stamp_ns,
            ("insertion_joint", "rotation_joint"),
            (CommandPoint((insertion, rotation), (), duration),),
        )

    def command(
        self,
        length: float = 0.001,
        rotation: float = 0.1,
        *,
        duration: float = 0.5,
        publishers: int = 1,
        stamp_ns: int | None = None,
    ) -> int:
        stamp = self.ros_ns if stamp_ns is None else stamp_ns
        here = self.positions
        self.supervisor.submit(
            self.step_command(here[0] + length, here[1] + rotation, stamp, duration),
            self.now,
            publishers,
        )
        return stamp
