"""Driver, emulated drives and somebody who gives orders, on a virtual runner."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from typing import Any

from needle_core import messages as m
from needle_core.can_frame import CAN, CanFrame
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
    Peers,
    PortChange,
    Publish,
    Timer,
)
from needle_core.runners.faults import Arrival, Arrivals, Fault, Link
from needle_core.runners.virtual import DIAGNOSTICS, VirtualRunner
from needle_device_driver.device_driver import DeviceDriver
from needle_device_driver.parameters import DeviceDriverParameters
from needle_sim.drive_emulator import DriveEmulator
from needle_sim.drive_emulator_parameters import DriveEmulatorParameters

_ALL = range(0x800)
DRIVER, DRIVES = DeviceDriver.name, DriveEmulator.name
# Events that only a runner knows of reach the driver by topics of the test's own.
INJECTED = {PortChange: "test/port", Peers: "test/peers"}


class Person(Component):
    """Holds, and does what a test asks for."""

    name = "person"

    def __init__(self) -> None:
        self.status: dict[str, str] = {}
        self.health: dict[str, dict[str, str]] = {}
        self.outcomes: list[str] = []
        self.answers: list[Answer] = []
        self.pressed = False
        self.actions: list[Action] = []
        self.inputs = (
            Input("device/status", m.Status, self._on_status, LATCHED),
            Input("device/result", m.CommandResult, self._on_result),
            Input(DIAGNOSTICS.topic, m.Diagnostics, self._on_health),
        )
        self.outputs = (
            Output("device/hold", m.HoldState, BEST_EFFORT),
            Output("device/joint_trajectory", m.Trajectory),
            Output("device/estop", m.EmergencyStop),
            *(Output(topic, kind) for kind, topic in INJECTED.items()),
        )
        self.timers = (Timer(0.01, self._act),)

    def on_answer(self, answer: Answer, at: Moment) -> Actions:
        self.answers.append(answer)
        return ()

    def _on_status(self, message: m.Status, at: Moment) -> Actions:
        self.status = message.values
        return ()

    def _on_health(self, message: m.Diagnostics, at: Moment) -> Actions:
        for status in message.statuses:
            if status.source == DRIVER:
                self.health[status.part] = {"text": status.text, **status.values}
        return ()

    def _on_result(self, message: m.CommandResult, at: Moment) -> Actions:
        self.outcomes.append(message.outcome)
        return ()

    def _act(self, at: Moment) -> Actions:
        scale = 1.0 if self.pressed else 0.0
        yield Publish(
            "device/hold", m.HoldState("person", "", at.stamp_ns, self.pressed, scale, 0.1)
        )
        yield from self.actions
        self.actions = []


class ComponentBench:
    """The three, and every frame between driver and drives."""

    def __init__(
        self,
        *,
        seed: int = 1,
        fault: Fault | None = None,
        drives: dict[str, Any] | None = None,
        **driver: Any,
    ) -> None:
        self.drives = DriveEmulator(DriveEmulatorParameters(**(drives or {})))
        settings = DeviceDriverParameters(link="virtual", channel=CAN, **driver)
        self.driver = DeviceDriver(settings)
        handlers: dict[type[Any], Callable[[Any, Moment], Actions]] = {
            PortChange: self.driver.ports[0].on_change,
            Peers: self.driver.on_peers,
        }
        injected = (Input(topic, kind, handlers[kind]) for kind, topic in INJECTED.items())
        self.driver.inputs = (*self.driver.inputs, *injected)
        self.person = Person()
        self.frames: list[tuple[float, str, CanFrame]] = []
        self.marked = 0.0
        self.runner = VirtualRunner(
            [self.drives, self.driver, self.person],
            seed,
            faults=(self._note, *([] if fault is None else [fault])),
        )

    def _note(self, link: Link, message: Any, now: float, rng: random.Random) -> Arrivals:
        if link.topic == CAN:
            self.frames += [(now, link.sender, frame) for frame in message]
        return (Arrival(0.0, message),)

    @property
    def state(self) -> str:
        return self.person.status.get("state", "")

    @property
    def fault(self) -> str:
        return self.person.status["fault"]

    @property
    def places(self) -> tuple[float, float]:
        """Where the motors really are [m], [rad]."""
        axes = self.drives.bus.axes(self.runner.now)
        return axes["insertion"].position, axes["rotation"].position

    def sent(self, *cob_ids: int, by: str = DRIVER) -> list[tuple[float, CanFrame]]:
        """Return frames of these COB-IDs since the mark, with their times."""
        return [
            (time, frame)
            for time, sender, frame in self.frames
            if time >= self.marked and sender == by and frame.identifier in (cob_ids or _ALL)
        ]

    @staticmethod
    def entry(frame: CanFrame) -> tuple[int, int]:
        """Return the index and subindex that an SDO frame is about."""
        return int.from_bytes(frame.data[1:3], "little"), frame.data[3]

    def mark(self) -> None:
        self.marked = self.runner.now

    def inject(self, event: PortChange | Peers) -> None:
        self.person.actions.append(Publish(INJECTED[type(event)], event))

    def run(self, seconds: float) -> None:
        end = self.runner.now + seconds
        while self.runner.now < end - 1e-9:
            self.runner.run(end - self.runner.now)

    def until(self, condition: Callable[[], bool], seconds: float = 5.0) -> float:
        """Run until something is so; return how long that took [s]."""
        begin = self.runner.now
        while not condition():
            assert self.runner.now < begin + seconds, self.person.status
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

    def press_stop(self, pressed: bool = True) -> None:
        self.person.actions.append(Publish("device/estop", m.EmergencyStop(pressed)))

    def set_up(self) -> None:
        self.until(lambda: self.state == "DISABLED")
        self.succeed("confirm_needle_out", True)

    def home(self) -> None:
        self.set_up()
        assert self.call("home").success

    def arm(self) -> None:
        """Enable once it is homed, and press the hold."""
        self.until(lambda: self.person.status["homed"] == "true", 10.0)
        self.succeed("enable", True)
        self.run(0.3)
        self.person.pressed = True
        self.run(0.1)

    def ready(self) -> None:
        self.home()
        self.arm()

    def step(self, length: float = 0.002, rotation: float = 0.5, duration: float = 1.0) -> None:
        insertion, turn = (
            float(self.person.status[key]) for key in ("insertion_m", "rotation_rad")
        )
        point = m.TrajectoryPoint((insertion + length, turn + rotation), duration)
        names = (m.INSERTION_JOINT, m.ROTATION_JOINT)
        stamp_ns = 1_000_000_000 + round(self.runner.now * 1e9)
        command = m.Trajectory(stamp_ns, names, (point,))
        self.person.actions.append(Publish("device/joint_trajectory", command))

    def moving(self) -> None:
        """Be in the middle of a step."""
        if not self.person.pressed:
            self.ready()
        begin = self.places[0]
        self.step()
        self.until(lambda: self.places[0] > begin + 0.0005)

    def rests(self, seconds: float = 0.5) -> bool:
        """Tell whether neither motor moves for some time."""
        at = self.places
        self.run(seconds)
        return self.places == at


def losing(
    identifiers: Sequence[int],
    begin: Callable[[], float],
    end: Callable[[], float] = lambda: math.inf,
) -> Fault:
    """Return a fault that loses the drives' frames of some identifiers from a time to another."""

    def fault(link: Link, message: Any, now: float, rng: random.Random) -> Arrivals:
        if link.topic != CAN or link.sender != DRIVES or not begin() <= now < end():
            return (Arrival(0.0, message),)
        kept = tuple(f for f in message if f.identifier not in identifiers)
        return (Arrival(0.0, kept),)

    return fault
