"""Somebody who holds, gives orders and hears all, beside components on a virtual runner."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from functools import partial
from typing import Any

from needle_core import messages as m
from needle_core.component import (
    BEST_EFFORT,
    LATCHED,
    Action,
    Actions,
    Answer,
    Call,
    Component,
    Input,
    Moment,
    Output,
    Port,
    Publish,
    Send,
    Timer,
)
from needle_core.runners.faults import Fault
from needle_core.runners.virtual import DIAGNOSTICS, LOG, VirtualRunner
from needle_core.status_messages import ControllerStatus, DeviceStatus
from needle_sim.drive_emulator import COMMAND_LINES

SIDES = ("left", "right")
KINDS: dict[str, type[Any]] = {
    "needle/tip": m.Point,
    "joint_states": m.JointState,
    "sim/tip_pose": m.Pose,
    "sim/drive_positions": m.JointState,
    "device/result": m.CommandResult,
    "device/estop": m.EmergencyStop,
    **{f"stereo/{side}/image_raw": m.Image for side in SIDES},
    DIAGNOSTICS.topic: m.Diagnostics,
}


class Person(Component):
    """Plays operator and controller, and keeps what it hears."""

    name = "person"

    def __init__(self) -> None:
        self.heard: dict[str, list[Any]] = defaultdict(list)
        self.answers: list[Answer] = []
        self.pressed, self.speaks = False, True
        self.actions: list[Action] = []
        self.inputs = (
            *(Input(topic, kind, partial(self._keep, topic)) for topic, kind in KINDS.items()),
            Input("device/status", DeviceStatus, partial(self._keep, "device/status"), LATCHED),
        )
        self.outputs = (
            Output("device/hold", m.HoldState, BEST_EFFORT),
            Output("device/joint_trajectory", m.Trajectory),
            Output("device/estop", m.EmergencyStop),
            Output("sim/drive_positions", m.JointState),
            Output("needle/controller_status", ControllerStatus, LATCHED),
        )
        self.ports = (Port(COMMAND_LINES, lambda *_: ()),)
        self.timers = (Timer(0.01, self._act),)

    def on_answer(self, answer: Answer, at: Moment) -> Actions:
        self.answers.append(answer)
        return ()

    def _keep(self, topic: str, message: Any, at: Moment) -> Actions:
        self.heard[topic].append(message)
        return ()

    def _act(self, at: Moment) -> Actions:
        if self.speaks:
            scale = 1.0 if self.pressed else 0.0
            hold = m.HoldState("person", "", at.stamp_ns, self.pressed, scale, 0.1)
            yield Publish("device/hold", hold)
        yield from self.actions
        self.actions = []


class VirtualBench:
    """Components and a person, on a virtual runner."""

    def __init__(
        self, *components: Component, seed: int = 1, faults: tuple[Fault, ...] = ()
    ) -> None:
        self.person = Person()
        self.logs: list[str] = []
        taps = (self._tap,)
        self.runner = VirtualRunner([*components, self.person], seed, faults=faults, taps=taps)

    def _tap(self, stamp_ns: int, sender: str, message: Any, output: Output) -> None:
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
    def answers(self) -> dict[str, Answer]:
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
        self.person.actions.append(Call(f"device/{service}", request))

    def call(self, service: str, request: bool | None = None) -> Answer:
        count = len(self.person.answers)
        self.ask(service, request)
        self.until(lambda: len(self.person.answers) > count)
        return self.person.answers[-1]

    def succeed(self, service: str, request: bool | None = None) -> None:
        """Call a service until it is done: drives take a while to switch off."""
        self.until(lambda: self.call(service, request).success)

    def publish(self, topic: str, message: Any) -> None:
        self.person.actions.append(Publish(topic, message))

    def press_stop(self, pressed: bool = True) -> None:
        self.publish("device/estop", m.EmergencyStop(pressed))

    def say(self, *lines: str) -> None:
        """Type lines into the drives' terminal."""
        self.person.actions.append(Send(COMMAND_LINES, lines))
        self.run(0.02)

    def command(self, length: float, rotation: float, duration: float, stamp_ns: int = 0) -> None:
        """Order a step from where the joints are."""
        at = self.heard("joint_states")[-1].positions
        point = m.TrajectoryPoint((at[0] + length, at[1] + rotation), duration)
        stamp_ns = stamp_ns or 1_000_000_000 + round(self.runner.now * 1e9)
        names = (m.INSERTION_JOINT, m.ROTATION_JOINT)
        self.publish("device/joint_trajectory", m.Trajectory(stamp_ns, names, (point,)))
