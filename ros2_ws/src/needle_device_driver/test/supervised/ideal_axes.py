"""A supervisor on two ideal axes."""

from __future__ import annotations

import math

from needle_device_driver.axes.axis import Axis, AxisError, AxisSnapshot
from needle_device_driver.procedure import Procedure, T, run_at_once
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_device_driver.supervisor.supervisor import MotionSupervisor

from .supervisor_bench import PERIOD, SupervisorBench


class IdealAxis(Axis):
    """Follows its set-points; fails, lags or is silent on demand."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.position = self.speed = 0.0
        self.target = math.nan
        self.powered = self.homed = self.homing = False
        self.unplugged = self.stuck = self.inner_switch = False
        self.switch: bool | None = None
        self.silent_since = math.inf
        self.fault = ""
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
        self.powered, self.target, self.homing = on, math.nan, False

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
        self.target, self.homing = math.nan, False

    def reset(self) -> Procedure[None]:
        yield from ()
        self._order("reset")
        self.fault = ""

    def close(self) -> Procedure[None]:
        yield from ()
        self._order("close")
        self.powered = False

    def poll(self, now: float) -> AxisSnapshot:
        return AxisSnapshot(
            time=min(now, self.silent_since),
            position=self.position,
            set_point=self.position,
            velocity=0.0,
            powered=self.powered,
            homed=self.homed,
            moving=self.homing,
            at_home_switch=self.position <= 0.0 if self.switch is None else self.switch,
            at_inner_switch=self.inner_switch,
            fault=self.fault,
        )

    def advance(self, period: float) -> None:
        if math.isnan(self.target) or not self.powered or self.stuck:
            return
        way, reach = self.target - self.position, self.speed * period
        if abs(way) <= reach * (1 + 1e-9):
            self.position = self.target
            self.homed, self.homing = self.homed or self.homing, False
        else:
            self.position += math.copysign(reach, way)


class Bench(SupervisorBench):
    """A supervisor on two ideal axes."""

    def __init__(self, **limits: float) -> None:
        super().__init__()
        self.insertion, self.rotation = IdealAxis("insertion"), IdealAxis("rotation")
        self.limits = SafetyLimits(**limits)
        self.supervisor = MotionSupervisor(self.insertion, self.rotation, self.limits)
        self.supervisor.note_time(0, self.now)
        self.supervisor.note_time(self.ros_ns, self.now)

    def run(self, procedure: Procedure[T]) -> T:
        return run_at_once(procedure)

    def exchange(self) -> None:
        self.supervisor.drive(PERIOD, self.now)
        self.insertion.advance(PERIOD)
        self.rotation.advance(PERIOD)
        self.supervisor.observe(self.now)

    def axis(self, name: str) -> IdealAxis:
        return {"insertion": self.insertion, "rotation": self.rotation}[name]

    @property
    def positions(self) -> tuple[float, float]:
        return self.insertion.position, self.rotation.position

    @property
    def set_points(self) -> tuple[float, float]:
        return self.positions

    def homed(self) -> Bench:
        """Configure, and begin to home."""
        self.configure()
        assert self.home().success
        return self

    def ready(self) -> Bench:
        """Enable, and press the hold."""
        self.homed()
        assert self.enable().success
        self.hold()
        return self

    def moving(self) -> Bench:
        """Begin a step of 2 mm and 0.1 rad in 2 s."""
        self.ready()
        self.step(0.002, 0.1, 2.0)
        self.go(5)
        assert self.state == "MOVING"
        return self

    def refused(self, rule: str) -> str:
        """Check that the last command was refused by a rule; return the reason."""
        self.go(3)
        assert self.rule == rule
        assert self.state != "MOVING"
        assert self.outcomes[-1].startswith("aborted: ")
        assert self.positions == (0.0, 0.0)
        return self.outcomes[-1]
