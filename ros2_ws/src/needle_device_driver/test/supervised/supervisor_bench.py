"""A supervisor with virtual time."""

from __future__ import annotations

import abc
import itertools
import math

from needle_core.messages import CommandResult, HoldState, Trajectory, TrajectoryPoint
from needle_core.status_messages import DeviceStatus
from needle_device_driver.procedure import Procedure, T
from needle_device_driver.supervisor.reports import Event, Notice, ServiceResult
from needle_device_driver.supervisor.supervisor import MotionSupervisor

PERIOD = 0.02
NAMES = ("insertion_joint", "rotation_joint")


def command(stamp_ns: int, *points: tuple[float, float, float]) -> Trajectory:
    """Return a command through points: insertion [m], rotation [rad], time from start [s]."""
    way = tuple(TrajectoryPoint((insertion, turn), time) for insertion, turn, time in points)
    return Trajectory(stamp_ns, NAMES, way)


def accepted(text: str) -> ServiceResult:
    """Return the answer to a call that is executed."""
    return ServiceResult(True, text)


def rejected(text: str) -> ServiceResult:
    """Return the answer to a call that is not executed."""
    return ServiceResult(False, text)


class SupervisorBench(abc.ABC):
    """Runs the cycles of a supervisor and records its events."""

    supervisor: MotionSupervisor

    def __init__(self) -> None:
        self.now, self.ros_ns = 1000.0, 1_000_000_000
        self.stamps = itertools.count(1)
        self.events: list[Event] = []

    @abc.abstractmethod
    def run(self, procedure: Procedure[T]) -> T:
        """Run a procedure to its end."""

    @property
    @abc.abstractmethod
    def set_points(self) -> tuple[float, float]:
        """Insertion [m] and rotation [rad] from which a command begins."""

    @abc.abstractmethod
    def exchange(self) -> None:
        """Run the supervisor's cycle."""

    # ---- reports ------------------------------------------------------------------------------

    @property
    def state(self) -> str:
        return self.supervisor.state.value

    @property
    def status(self) -> DeviceStatus:
        return self.supervisor.status(self.now)

    def is_homed(self) -> bool:
        return self.status.homed

    @property
    def notices(self) -> list[Notice]:
        self.events += self.supervisor.pop_events()
        return [event for event in self.events if isinstance(event, Notice)]

    @property
    def rule(self) -> str:
        """Name of the rule behind the last notice; empty if there is none."""
        rules = [notice.rule for notice in self.notices]
        return rules[-1].value if rules and rules[-1] is not None else ""

    @property
    def results(self) -> list[tuple[int, str]]:
        self.events += self.supervisor.pop_events()
        return [(e.stamp_ns, e.outcome) for e in self.events if isinstance(e, CommandResult)]

    @property
    def outcomes(self) -> list[str]:
        return [outcome for _, outcome in self.results]

    # ---- actions of a person ------------------------------------------------------------------

    def hold(
        self,
        pressed: bool = True,
        *,
        sender: str = "a",
        scale: float = 1.0,
        session: str = "",
        count: int | None = None,
        lifetime: float = math.inf,
    ) -> str:
        """Send a hold message; return the owner."""
        number = next(self.stamps) if count is None else count
        message = HoldState(sender, session, number, pressed, scale, lifetime)
        self.supervisor.receive_hold(message, self.now)
        return self.status.hold_owner

    def press(self) -> None:
        """Release and press again."""
        self.hold(False)
        self.hold()

    def enable(self, on: bool = True) -> ServiceResult:
        return self.supervisor.enable(on, self.now)

    def retract(self) -> ServiceResult:
        return self.supervisor.retract(self.now)

    def reset(self) -> ServiceResult:
        return self.run(self.supervisor.reset(self.now))

    def configure(self) -> ServiceResult:
        return self.run(self.supervisor.configure(self.now))

    def home(self) -> ServiceResult:
        self.supervisor.confirm_needle_out(True)
        return self.run(self.supervisor.home(self.now))

    def submit(
        self,
        *points: tuple[float, float, float],
        stamp_ns: int | None = None,
        publishers: int = 1,
    ) -> int:
        """Send a command through points; return its stamp."""
        stamp = self.ros_ns if stamp_ns is None else stamp_ns
        self.supervisor.submit(command(stamp, *points), self.now, publishers)
        return stamp

    def step(
        self, length: float = 0.001, rotation: float = 0.1, duration: float = 0.5, **details: int
    ) -> int:
        """Submit a step from the last set-points; return its stamp."""
        insertion, turn = self.set_points
        return self.submit((insertion + length, turn + rotation, duration), **details)

    # ---- time ---------------------------------------------------------------------------------

    def go(self, cycles: int = 1, scale: float = 1.0) -> None:
        """Run cycles while the hold is pressed."""
        for _ in range(cycles):
            self._tick()
            self.hold(scale=scale)
            self.exchange()

    def wait(self, cycles: int = 1) -> None:
        """Run cycles without hold messages."""
        for _ in range(cycles):
            self._tick()
            self.exchange()

    def _tick(self) -> None:
        self.now += PERIOD
        self.ros_ns += 20_000_000
        self.supervisor.note_time(self.ros_ns, self.now)
