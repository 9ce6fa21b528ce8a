"""The stand-in as a component, before a rig that a test plays."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from needle_bringup.simulated_operator.component import PROGRESS, SimulatedOperator
from needle_bringup.simulated_operator.parameters import SimulatedOperatorParameters
from needle_core import messages as m
from needle_core.component import (
    BEST_EFFORT,
    LATCHED,
    Actions,
    Component,
    Input,
    Moment,
    Output,
    Port,
    Publish,
    Reply,
    Service,
    Timer,
)
from needle_core.diagnostics import Level
from needle_core.runners.virtual import DIAGNOSTICS, VirtualRunner
from needle_core.status_messages import ControllerStatus, DeviceStatus

CONFIRM, HOME, START = "device/confirm_needle_out", "device/home", "plane_controller/start"
STARTED = [f"{CONFIRM} True", HOME, "device/enable True", START]
DISABLE = "device/enable False"


class PlayedRig(Component):
    """Answers like sim_rig and plane_controller; remembers what was asked and held."""

    name = "played_rig"

    def __init__(self) -> None:
        self.device = DeviceStatus(source=self.name, homed=True, state="DISABLED", simulated=True)
        self.controller = ControllerStatus(state="IDLE", starts=0, depth_m=0.12)
        self.refusal, self.recorded = "", ""
        self.mute: set[str] = set()
        self.asked: list[str] = []
        self.holds: list[m.HoldState] = []
        self.shown: list[Any] = []
        self.inputs = (Input("device/hold", m.HoldState, self._on_hold, BEST_EFFORT),)
        self.outputs = (
            Output("device/status", DeviceStatus, LATCHED),
            Output("needle/controller_status", ControllerStatus, LATCHED),
            DIAGNOSTICS,
        )
        self.ports = (Port(PROGRESS, self._show),)
        self.services = tuple(
            Service(name, self._answering(name), takes)
            for name, takes in (
                (CONFIRM, True),
                (HOME, False),
                ("device/enable", True),
                (START, False),
            )
        )
        self.timers = (Timer(0.1, self._tell),)

    def _on_hold(self, hold: m.HoldState, at: Moment) -> Actions:
        self.holds.append(hold)
        return ()

    def _show(self, batch: Sequence[Any], at: Moment) -> Actions:
        self.shown += batch
        return ()

    def _tell(self, at: Moment) -> Actions:
        yield Publish("device/status", self.device)
        self.device = dataclasses.replace(self.device, state="DISABLED")
        yield Publish("needle/controller_status", self.controller)
        if self.recorded:
            told = m.Status("/recorder", "parameters_of", Level.OK, self.recorded, {})
            yield Publish(DIAGNOSTICS.topic, m.Diagnostics(at.stamp_ns, (told,)))

    def _answering(self, name: str) -> Any:
        def answer(data: bool | None, number: int, at: Moment) -> Actions:
            asked = name if data is None else f"{name} {data}"
            self.asked.append(asked)
            if name == START and not self.refusal:
                said: dict[str, Any] = {"state": "STEERING", "starts": 1}
                self.controller = dataclasses.replace(self.controller, **said)
            if name == HOME:
                self.device = dataclasses.replace(self.device, state="MOVING")
            if asked in self.mute:
                self.mute.remove(asked)
            else:
                yield Reply(number, not self.refusal, self.refusal or "homing" * (name == HOME))

        return answer

    def tell(self, state: str, step: int, reason: str = "") -> None:
        self.controller = dataclasses.replace(
            self.controller, state=state, step=step, insertion_m=step * 1e-3, reason=reason
        )


class Scene:
    """The stand-in before a played rig."""

    def __init__(self, *, mute: str = "", run: bool = True, **settings: Any) -> None:
        self.rig = PlayedRig()
        self.rig.mute = {mute} - {""}
        self.operator = SimulatedOperator(SimulatedOperatorParameters(**settings))
        self.runner = VirtualRunner([self.operator, self.rig], 1)
        if run:
            self.steer()

    def steer(self) -> None:
        self.runner.run(4.0)
        self.rig.tell("STEERING", 1)
        self.runner.run(1.0)

    def end(self) -> tuple[int, str]:
        assert self.runner.run(10.0)
        ended = self.runner.exits["simulated_operator"]
        assert not self.rig.holds or not self.rig.holds[-1].pressed
        return ended.code, ended.text


def test_it_prepares_holds_until_done_releases_and_disables() -> None:
    scene = Scene()
    rig = scene.rig
    assert rig.asked == STARTED
    pressed = [hold.pressed for hold in rig.holds]
    # A press from before it was ready would not count; then it is kept.
    assert pressed == sorted(pressed)
    assert (pressed[0], pressed[-1]) == (False, True)
    assert (rig.holds[-1].source, rig.holds[-1].speed_scale) == ("simulated_operator", 1.0)
    assert (rig.shown[-1].insertion, rig.shown[-1].depth) == (0.001, 0.12)
    rig.tell("DONE", 120)
    assert scene.end() == (0, "inserted 120.0 mm in 120 steps")
    assert rig.asked == [*STARTED, DISABLE]


def test_a_signal_releases_and_disables_before_the_end_and_a_second_one_ends_at_once() -> None:
    for mute in ("", DISABLE):
        scene = Scene(mute=mute)
        scene.runner.stop("simulated_operator")
        if mute:
            scene.runner.run(0.5)
            assert not scene.runner.exits
            scene.runner.stop("simulated_operator")
        assert scene.end() == (130, "interrupted")
        assert scene.rig.asked[-1] == DISABLE


def test_a_fault_and_a_refusal_are_its_reason() -> None:
    scene = Scene()
    scene.rig.tell("FAULT", 7, "the needle is gone")
    assert scene.end() == (1, "plane_controller FAULT: the needle is gone")
    refused = Scene(run=False)
    refused.rig.refusal = "the door is open"
    code, said = refused.end()
    assert (code, "the door is open" in said) == (2, True)
    assert not any(hold.pressed for hold in refused.rig.holds)


def test_answers_that_are_lost_are_asked_for_again() -> None:
    for mute in STARTED:
        scene = Scene(mute=mute)
        assert not scene.rig.mute
        assert list(dict.fromkeys(scene.rig.asked)) == STARTED
        # That it homes or was started is seen.
        assert scene.rig.asked.count(mute) == (1 if mute in (HOME, START) else 2)
        assert scene.rig.holds[-1].pressed


def test_a_real_device_is_asked_for_nothing_and_a_second_one_ends_it() -> None:
    real = Scene(run=False)
    real.rig.device = dataclasses.replace(real.rig.device, simulated=False)
    code, said = real.end()
    assert (code, "played_rig is a real device" in said) == (2, True)
    assert (real.rig.asked, real.rig.holds) == ([], [])
    scene, second = Scene(), PlayedRig()
    second.name, second.services = "device_driver", ()
    scene.runner.start(second)
    code, said = scene.end()
    assert (code, "more than one device" in said) == (1, True)
    assert "device_driver" in said


def test_it_waits_until_the_recorder_has_the_parameters_of_all() -> None:
    scene = Scene(run=False, wait_for_recorder=True)
    scene.rig.recorded = "/simulated_operator"
    scene.runner.run(2.0)
    assert scene.rig.asked == []
    scene.rig.recorded = "/simulated_operator, /played_rig"
    scene.runner.run(2.0)
    assert scene.rig.asked == STARTED
