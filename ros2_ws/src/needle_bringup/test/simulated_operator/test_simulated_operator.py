"""The simulated operator as a component: rig messages become the hold, calls, and an end."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

from needle_bringup.simulated_operator.component import (
    SimulatedOperator,
    SimulatedOperatorParameters,
)
from needle_core import messages as m
from needle_core.component import Action, Answer, Call, Exit, Moment, Peers, Publish, Send
from needle_core.diagnostics import Level
from needle_core.status_messages import ControllerStatus, DeviceStatus

CONFIRM, HOME, START = "device/confirm_needle_out", "device/home", "plane_controller/start"
STARTED = [(CONFIRM, True), (HOME, None), ("device/enable", True), (START, None)]
DISABLE = ("device/enable", False)
RIG = "sim_rig"


class Scene:
    """Simulated operator in a rig that accepts all calls, or answers none."""

    def __init__(self, *, refusal: str = "", mute: bool = False, **settings: Any) -> None:
        self.operator = SimulatedOperator(SimulatedOperatorParameters(**settings), "stand_in")
        self.refusal, self.mute = refusal, mute
        self.now = 0.0
        self.device = DeviceStatus(source=RIG, homed=True, state="DISABLED", simulated=True)
        self.controller = ControllerStatus(state="IDLE", starts=0, depth_m=0.12)
        self.asked: list[tuple[str, bool | None]] = []
        self.holds: list[m.HoldState] = []
        self.shown: list[ControllerStatus] = []
        self.end: Exit | None = None
        self.discover((RIG,))

    @property
    def at(self) -> Moment:
        return Moment(self.now, round(self.now * 1e9))

    def discover(self, devices: tuple[str, ...]) -> None:
        topics = {"device/status": devices, "needle/controller_status": (RIG,)}
        services = frozenset(service for service, _ in STARTED)
        peers = Peers(topics, {"device/hold": devices}, services, frozenset({RIG, "stand_in"}))
        self.take(self.operator.on_peers(peers, self.at))

    def take(self, actions: Iterable[Action]) -> None:
        for action in actions:
            match action:
                case Publish():
                    self.holds.append(action.message)
                case Send():
                    self.shown += action.batch
                case Exit():
                    self.end = action
                case Call(service, data):
                    self.asked.append((service, data))
                    if not self.mute:
                        answer = Answer(service, not self.refusal, self.refusal)
                        self.take(self.operator.on_answer(answer, self.at))

    def run(self, seconds: float = 1.0, **changes: Any) -> None:
        """Publish a controller status, and advance time."""
        self.controller = dataclasses.replace(self.controller, **changes)
        rows = {row.topic: row.handler for row in self.operator.inputs}
        for _ in range(round(seconds / 0.05)):
            self.now += 0.05
            self.take(rows["device/status"](self.device, self.at))
            self.take(rows["needle/controller_status"](self.controller, self.at))
            self.take(self.operator.timers[0].handler(self.at))


def steered() -> Scene:
    scene = Scene()
    scene.run()
    scene.run(state="STEERING", starts=1, step=1, insertion_m=0.001)
    assert scene.asked == STARTED
    assert scene.holds[-1].pressed
    return scene


def test_the_component_prepares_holds_releases_and_disables() -> None:
    scene = Scene(mute=True)
    scene.run(0.2)
    # A press before the device is ready would not count.
    assert scene.holds
    assert not any(hold.pressed for hold in scene.holds)
    scene.mute = False
    scene.run(1.5)
    scene.run(state="STEERING", starts=1, step=1, insertion_m=0.001)
    assert scene.asked == [STARTED[0], *STARTED]
    held = scene.holds[-1]
    assert (held.pressed, held.source, held.speed_scale) == (True, "stand_in", 1.0)
    assert (scene.shown[-1].insertion_m, scene.shown[-1].depth_m) == (0.001, 0.12)
    scene.run(state="DONE", step=120, insertion_m=0.12)
    assert scene.end == Exit(0, "inserted 120.0 mm in 120 steps")
    assert scene.asked[-2:] == [STARTED[-1], DISABLE]
    assert [hold.pressed for hold in scene.holds[-3:]] == [False] * 3


def test_a_signal_releases_and_disables_before_the_end_and_a_second_one_ends_at_once() -> None:
    for mute in (False, True):
        scene = steered()
        scene.mute = mute
        scene.take(scene.operator.on_stop(scene.at))
        assert not scene.holds[-1].pressed
        assert scene.asked[-1] == DISABLE
        if mute:
            assert scene.end is None
            scene.take(scene.operator.on_stop(scene.at))
        assert scene.end == Exit(130, "interrupted")


def test_a_refusal_and_a_real_device_are_bad_input() -> None:
    refused = Scene(refusal="the door is open")
    refused.run(5.0)
    assert refused.end == Exit(2, "device/confirm_needle_out was refused: the door is open")
    assert not any(hold.pressed for hold in refused.holds)
    real = Scene()
    real.device = dataclasses.replace(real.device, simulated=False)
    real.run()
    assert real.end is not None
    assert (real.end.code, "sim_rig is a real device" in real.end.text) == (2, True)
    assert (real.asked, real.holds) == ([], [])


def test_it_waits_until_the_recorder_has_all_parameters() -> None:
    scene = Scene(wait_for_recorder=True)
    (row,) = (row for row in scene.operator.inputs if row.topic == "/diagnostics")
    for recorded, asked in (("/stand_in", []), (f"/stand_in, /{RIG}", STARTED)):
        status = m.Status("/recorder", "parameters_of", Level.OK, recorded)
        scene.take(row.handler(m.Diagnostics(scene.at.stamp_ns, (status,)), scene.at))
        scene.run()
        assert scene.asked == asked
