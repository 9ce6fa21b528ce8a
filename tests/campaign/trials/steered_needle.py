"""One insertion in one process on a virtual clock: controller, device and needle without a graph.

The step protocol, the motion supervisor and the plant are those of the nodes; messages between them
take the time that they are told to.
"""

from __future__ import annotations

import dataclasses
import heapq
import itertools
import math
from collections.abc import Callable

import numpy as np

from needle_controller.plane_controller import trajectory
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.continuous import make_steering
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.steering_types import (
    Action,
    SendPath,
    SendStep,
    SteeringState,
)
from needle_controller.protocol.tip_gate import TipMeasurement
from needle_core.messages import HoldState
from needle_device_driver.procedure import run_at_once
from needle_device_driver.supervisor.command import (
    Command,
    CommandPoint,
)
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_device_driver.supervisor.reports import StepResult
from needle_device_driver.supervisor.supervisor import MotionSupervisor
from needle_sim.needle.se3 import FloatArray
from needle_sim.rig.bench import SimulatedBench
from needle_sim.rig.simulated_axis import SimulatedAxis

TICK_NS = 10_000_000
_TICK = TICK_NS * 1e-9
_START_NS = 1_000_000_000


@dataclasses.dataclass(frozen=True)
class Hand:
    """A person's action at a moment.

    Attributes
    ----------
    pressed : bool
        Whether the hold is pressed.
    speed_scale : float
        Share of the nominal speed, 0..1.
    push : float
        Speed at which the needle itself is pushed, of an axis that no motor moves [m/s].
    """

    pressed: bool
    speed_scale: float = 1.0
    push: float = 0.0


class HandAxis(SimulatedAxis):
    """An insertion axis that is read and never driven."""

    actuated = False

    def push(self, distance: float) -> None:
        """Move by a distance [m], as a hand does."""
        self._position += distance
        self._velocity = distance / _TICK


class SteeredNeedle:
    """A needle that is steered while a person holds.

    Parameters
    ----------
    settings : SteeringSettings
        The controller's.
    bench : SimulatedBench
        The needle.
    hand : callable
        What a person does at a time [s].
    tip_period : float
        Time between two exposures [s].
    latency : float
        From exposure to the controller [s].
    pushed : bool
        Whether a hand moves the insertion axis.
    measure : callable, optional
        From the number of an exposure to the measured tip, shape (3,) [m]; the bench's own.
    """

    def __init__(
        self,
        settings: SteeringSettings,
        bench: SimulatedBench,
        hand: Callable[[float], Hand],
        *,
        tip_period: float,
        latency: float,
        pushed: bool = False,
        measure: Callable[[int], FloatArray] | None = None,
    ) -> None:
        self.steering = make_steering(settings)
        self._bench = bench
        self._hand = hand
        self._measure = bench.measure_tip if measure is None else measure
        self._frame_ns = round(tip_period * 1e9)
        self._latency_ns = round(latency * 1e9)
        self._insertion = HandAxis("insertion") if pushed else SimulatedAxis("insertion")
        self._rotation = SimulatedAxis("rotation")
        limits = SafetyLimits(max_depth=settings.depth + 0.01)
        self.device = MotionSupervisor(self._insertion, self._rotation, limits)
        self.time_ns = _START_NS
        self._exposed_ns = -self._frame_ns
        self._exposures = 0
        self._under_way: list[tuple[int, int, TipMeasurement]] = []
        self._order = itertools.count()
        self._joints_told_ns = 0
        self.insertions: list[float] = []
        self.offsets: list[float] = []
        self.outcomes: list[str] = []
        self._make_ready()

    @property
    def seconds(self) -> float:
        """Time since the start [s]."""
        return (self.time_ns - _START_NS) * 1e-9

    def run(self, longest: float) -> bool:
        """Let time go by until steering ends, at the longest so long [s]; return whether it did."""
        while self.steering.state in {SteeringState.STEERING, SteeringState.WAITING_FOR_TIP}:
            if self.seconds > longest:
                return False
            self.tick()
        return True

    def tick(self) -> None:
        """Let a tick go by."""
        self.time_ns += TICK_NS
        now = self.time_ns * 1e-9
        hand = self._hand(self.seconds)
        self.device.receive_hold(
            HoldState("person", "", self.time_ns, hand.pressed, hand.speed_scale), now
        )
        self.device.note_time(self.time_ns, now)
        self.device.drive(_TICK, now)
        if isinstance(self._insertion, HandAxis):
            self._insertion.push(hand.push * _TICK)
        else:
            self._insertion.advance(_TICK)
        self._rotation.advance(_TICK)
        self._bench.move_to(self._insertion.position, self._rotation.position)
        self.device.observe(now)
        self.insertions.append(self._insertion.position)
        self.offsets.append(float(self._bench.tip[0]))
        if self.time_ns - self._joints_told_ns >= 2 * TICK_NS:
            self._tell_joints()
        self._tell_device()
        if self.time_ns - self._exposed_ns >= self._frame_ns:
            self._expose()
        while self._under_way and self._under_way[0][0] <= self.time_ns:
            if self._joints_told_ns < self._under_way[0][2].stamp_ns:
                break
            self._do(self.steering.on_tip(heapq.heappop(self._under_way)[2]))
        self._do(self.steering.on_time(now))

    def _make_ready(self) -> None:
        now = self.time_ns * 1e-9
        self.device.note_time(0, now)
        self.device.note_time(self.time_ns, now)
        run_at_once(self.device.configure(now))
        self.device.confirm_needle_out(True)
        assert run_at_once(self.device.home(now)).success
        self.device.observe(now)
        assert self.device.enable(True, now).success
        self.device.receive_hold(HoldState("person", "", 0, False, 0.0), now)
        self._tell_device()
        self._tell_joints()
        reply, actions = self.steering.on_start()
        assert reply.success, reply.message
        self._do(actions)

    def _expose(self) -> None:
        # At the camera's own times, whatever the ticks.
        self._exposed_ns = max(self._exposed_ns + self._frame_ns, self.time_ns - self._frame_ns + 1)
        tip = TipMeasurement(self.time_ns, "rig", self._measure(self._exposures))
        self._exposures += 1
        arrival = self.time_ns + self._latency_ns
        heapq.heappush(self._under_way, (arrival, next(self._order), tip))

    def _tell_joints(self) -> None:
        self._joints_told_ns = self.time_ns
        sample = JointSample(
            self.time_ns, self._insertion.position, self._rotation.position, self.time_ns
        )
        self._do(self.steering.on_joints(sample))

    def _tell_device(self) -> None:
        for event in self.device.take_events():
            if isinstance(event, StepResult):
                self.outcomes.append(event.outcome)
                self._do(self.steering.on_result(event.stamp_ns, event.outcome, self.time_ns))
        self._do(self.steering.on_device(self.device.status(self.time_ns * 1e-9)))

    def _do(self, actions: list[Action]) -> None:
        for action in actions:
            if isinstance(action, SendStep | SendPath):
                self.device.submit(_command(action), self.time_ns * 1e-9)


def rms_at_end(needle: SteeredNeedle, offset: float, length: float = 0.02) -> float:
    """Return the RMS distance from a plane x = `offset` over the last `length` of insertion [m]."""
    insertions = np.array(needle.insertions)
    grid = np.linspace(insertions[-1] - length, insertions[-1], 201)
    away = np.interp(grid, insertions, np.array(needle.offsets)) - offset
    return math.sqrt(float(np.mean(away**2)))


def _command(action: SendStep | SendPath) -> Command:
    sent = trajectory(action)
    points = tuple(CommandPoint(p.positions, p.others, p.time_from_start) for p in sent.points)
    return Command(sent.stamp_ns, sent.joint_names, points)
