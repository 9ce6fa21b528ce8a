"""Somebody who holds, gives orders and hears all, beside components on a virtual runner."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from functools import partial
from typing import Any

from needle_core import component as c
from needle_core import messages as m
from needle_core.runners.faults import Fault
from needle_core.runners.virtual import DIAGNOSTICS, LOG, VirtualRunner
from needle_core.status_messages import ControllerStatus, DeviceStatus
from needle_sim.drive_emulator import ADAPTER, COMMAND_LINES

SIDES = ("left", "right")
KINDS: dict[str, type[Any]] = {
    "needle/tip": m.Point,
    "needle/tip_pose": m.PoseWithCovariance,
    "joint_states": m.JointState,
    "sim/tip_pose": m.Pose,
    "sim/drive_positions": m.JointState,
    "device/result": m.CommandResult,
    "device/estop": m.EmergencyStop,
    **{f"stereo/{side}/image_raw": m.Image for side in SIDES},
    DIAGNOSTICS.topic: m.Diagnostics,
}


class Person(c.Component):
    """Plays operator and controller, and keeps what it hears."""

    name = "person"

    def __init__(self) -> None:
        self.heard: dict[str, list[Any]] = defaultdict(list)
        self.answers: list[c.Answer] = []
        self.pressed, self.speaks = False, True
        self.actions: list[c.Action] = []
        self.inputs = (
            *(c.Input(topic, kind, partial(self._keep, topic)) for topic, kind in KINDS.items()),
            c.Input("device/status", DeviceStatus, partial(self._keep, "device/status"), c.LATCHED),
        )
        self.outputs = (
            c.Output("device/hold", m.HoldState, c.BEST_EFFORT),
            c.Output("device/joint_trajectory", m.Trajectory),
            c.Output("device/estop", m.EmergencyStop),
            c.Output("sim/drive_positions", m.JointState),
            c.Output("needle/controller_status", ControllerStatus, c.LATCHED),
        )
        self.ports = (
            c.Port(COMMAND_LINES, lambda *_: ()),
            c.Port(ADAPTER, partial(self._keep, ADAPTER)),
        )
        self.timers = (c.Timer(0.01, self._act),)

    def on_answer(self, answer: c.Answer, at: c.Moment) -> c.Actions:
        self.answers.append(answer)
        return ()

    def _keep(self, topic: str, message: Any, at: c.Moment) -> c.Actions:
        self.heard[topic].append(message)
        return ()

    def _act(self, at: c.Moment) -> c.Actions:
        if self.speaks:
            scale = 1.0 if self.pressed else 0.0
            hold = m.HoldState("person", "", at.stamp_ns, self.pressed, scale, 0.1)
            yield c.Publish("device/hold", hold)
        yield from self.actions
        self.actions = []


class VirtualBench:
    """Components and a person, on a virtual runner."""

    def __init__(
        self, *components: c.Component, seed: int = 1, faults: tuple[Fault, ...] = ()
    ) -> None:
        self.person = Person()
        self.logs: list[str] = []
        taps = (self._tap,)
        self.runner = VirtualRunner([*components, self.person], seed, faults=faults, taps=taps)

    def _tap(self, stamp_ns: int, sender: str, message: Any, output: c.Output) -> None:
        if output.topic == LOG.topic:
            self.logs.append(message.text)

    def heard(self, topic: str) -> list[Any]:
        return self.person.heard[topic]

    @property
    def status(self) -> DeviceStatus:
        said = self.heard("device/status")
        return said[-1] if said else DeviceStatus()

    @property
    def outcomes(self) -> list[str]:
        return [result.outcome for result in self.heard("device/result")]

    @property
    def answers(self) -> dict[str, c.Answer]:
        """The last answer of each service."""
        return {answer.service.removeprefix("device/"): answer for answer in self.person.answers}

    def run(self, seconds: float) -> None:
        end = self.runner.now + seconds
        while self.runner.now < end - 1e-9:
            self.runner.run(end - self.runner.now)

    def until(self, condition: Callable[[], Any], seconds: float = 10.0) -> float:
        """Run until something is so; return how long that took [s]."""
        begin = self.runner.now
        while not condition():
            assert self.runner.now < begin + seconds, self.status
            self.run(0.002)
        return self.runner.now - begin

    def ask(self, service: str, request: bool | None = None) -> None:
        self.person.actions.append(c.Call(f"device/{service}", request))

    def call(self, service: str, request: bool | None = None) -> c.Answer:
        count = len(self.person.answers)
        self.ask(service, request)
        self.until(lambda: len(self.person.answers) > count)
        return self.person.answers[-1]

    def succeed(self, service: str, request: bool | None = None) -> None:
        """c.Call a service until it is done: drives take a while to switch off."""
        self.until(lambda: self.call(service, request).success)

    def publish(self, topic: str, message: Any) -> None:
        self.person.actions.append(c.Publish(topic, message))

    def press_stop(self, pressed: bool = True) -> None:
        self.publish("device/estop", m.EmergencyStop(pressed))

    def say(self, *lines: str) -> None:
        """Type lines into the drives' terminal."""
        self.person.actions.append(c.Send(COMMAND_LINES, lines))
        self.run(0.02)

    def command(self, length: float, rotation: float, duration: float, stamp_ns: int = 0) -> None:
        """Order a step from where the joints are."""
        at = self.heard("joint_states")[-1].positions
        point = m.TrajectoryPoint((at[0] + length, at[1] + rotation), duration)
        stamp_ns = stamp_ns or 1_000_000_000 + round(self.runner.now * 1e9)
        names = (m.INSERTION_JOINT, m.ROTATION_JOINT)
        self.publish("device/joint_trajectory", m.Trajectory(stamp_ns, names, (point,)))
