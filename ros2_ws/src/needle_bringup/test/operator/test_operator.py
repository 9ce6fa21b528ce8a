"""The operator as a component: a hand at its port, or on a joystick's topic, before a rig."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import pytest

from needle_bringup.operator.component import INPUT_DEVICE, Operator
from needle_bringup.operator.controls import Controls
from needle_bringup.operator.hand import Hand, Lost, Reading
from needle_bringup.operator.parameters import OperatorParameters
from needle_core import messages as m
from needle_core.component import (
    BEST_EFFORT,
    Actions,
    Component,
    Moment,
    Output,
    Port,
    Publish,
    Reply,
    Send,
    Service,
    Timer,
)
from needle_core.errors import UserError
from needle_core.runners.virtual import LOG, VirtualRunner
from needle_core.status_messages import DeviceStatus

PEDAL = OperatorParameters(device="/dev/input/pedal", key=48, retract_key=49, stop_key=50)
JOYSTICK = OperatorParameters(source="joy", key=0, retract_key=1, stop_key=2, speed_axis=0)
STOP_STEERING, RETRACT, STOP = "plane_controller/stop", "device/retract", "device/stop"
NEUTRAL = Hand()


class Desk(Component):
    """A hand on a pedal and on a joystick, and a rig that agrees to what is called."""

    name = "desk"

    def __init__(self) -> None:
        self.reading: Reading = NEUTRAL
        self.down: set[int] = set()
        self.silent = False
        self.status = DeviceStatus()
        self.called: list[str] = []
        self.speeds: list[float] = []
        self.outputs = (
            Output("joy", m.Joystick, BEST_EFFORT),
            Output("device/status", DeviceStatus),
        )
        self.ports = (Port(INPUT_DEVICE, self._take),)
        self.services = tuple(
            Service(name, self._agree(name)) for name in (STOP_STEERING, RETRACT, STOP)
        )
        self.timers = (Timer(0.02, self._tell),)

    def _take(self, batch: Sequence[float], at: Moment) -> Actions:
        self.speeds += batch
        return ()

    def _tell(self, at: Moment) -> Actions:
        yield Publish("device/status", self.status)
        yield Send(INPUT_DEVICE, (Lost("an older reading"), self.reading))
        if not self.silent:
            buttons = tuple(int(button in self.down) for button in range(3))
            yield Publish("joy", m.Joystick(at.stamp_ns, (0.6,), buttons))

    def _agree(self, name: str) -> Any:
        def agree(_: bool | None, number: int, at: Moment) -> Actions:
            self.called.append(name)
            yield Reply(number, True)

        return agree


class Scene:
    """An operator before a desk, and the holds that it publishes."""

    def __init__(self, settings: OperatorParameters, *down: int) -> None:
        self.holds: list[m.HoldState] = []
        self.logs: list[str] = []
        self.desk = Desk()
        self.desk.down = set(down)
        self.runner = VirtualRunner([Operator(settings), self.desk], 1, taps=(self._note,))
        self.runner.run(0.5)

    def _note(self, stamp_ns: int, sender: str, message: object, output: Output) -> None:
        if isinstance(message, m.HoldState):
            self.holds.append(message)
        elif output == LOG and isinstance(message, m.LogLine):
            self.logs.append(message.text)

    def then(self, reading: Reading = NEUTRAL, *down: int, **status: Any) -> m.HoldState:
        self.desk.reading, self.desk.down = reading, set(down)
        self.desk.status = dataclasses.replace(self.desk.status, **status)
        self.runner.run(0.15)
        return self.holds[-1]


def test_a_pedal_at_the_port_is_held_until_it_is_lost() -> None:
    scene = Scene(PEDAL)
    assert not scene.then().pressed
    held = scene.then(Hand(insert=True, speed=0.5))
    assert (held.source, held.pressed, held.speed_scale) == ("operator", True, 0.5)
    assert held.lifetime == m.HOLD_LIFETIME
    scene.then(Hand(insert=True), press_again="operator")
    assert "the device does not take this press" in scene.logs[-1]
    assert not scene.then(Lost("unplugged")).pressed
    assert scene.logs[-1] == "nothing is held: unplugged"
    assert not scene.then(Hand(insert=True)).pressed
    assert "what is held does not count" in scene.logs[-1]
    assert [hold.count for hold in scene.holds] == list(range(1, len(scene.holds) + 1))
    assert len({hold.session for hold in scene.holds}) == 1


def test_a_joystick_holds_at_its_axis_speed_stops_and_must_go_on_talking() -> None:
    # Pressed from the start on: it does not count.
    scene = Scene(JOYSTICK, 0)
    assert len(scene.holds) > 15
    assert not any(hold.pressed for hold in scene.holds)
    scene.then()
    held = scene.then(NEUTRAL, 0)
    assert held.pressed
    assert held.speed_scale == pytest.approx(0.8)
    assert not scene.then(NEUTRAL, 0, 2).pressed
    assert scene.desk.called == [STOP]
    assert not scene.then(NEUTRAL, 0).pressed
    scene.then()
    assert scene.then(NEUTRAL, 0).pressed
    scene.desk.silent = True
    assert not scene.then(NEUTRAL, 0).pressed
    scene.desk.silent = False
    assert not scene.then(NEUTRAL, 0).pressed
    assert scene.desk.called == [STOP]


def test_the_controller_is_stopped_before_the_needle_is_drawn_out() -> None:
    scene, out = Scene(PEDAL), Hand(retract=True)
    scene.then()
    assert scene.then(out).pressed
    assert scene.desk.called == [STOP_STEERING]
    assert scene.logs[-1] == "held to draw the needle out"
    scene.then(out, hold_owner="operator")
    assert scene.desk.called == [STOP_STEERING, RETRACT]
    assert scene.then(out, activity="retraction").pressed
    assert not scene.then(out, activity="none").pressed
    scene.then()
    scene.then(out, hold_owner="")
    # Nobody takes the hold.
    scene.runner.run(1.5)
    assert not scene.holds[-1].pressed
    assert "not drawn out: the device does not take the hold" in scene.logs[-1]


def test_a_new_speed_reaches_the_hand_and_whoever_ends_releases() -> None:
    scene = Scene(PEDAL)
    scene.runner.configure("operator", dataclasses.replace(PEDAL, speed_scale=0.25))
    scene.then()
    assert scene.desk.speeds == [0.25]
    assert scene.then(Hand(insert=True)).pressed
    scene.runner.stop("operator")
    assert scene.runner.run(1.0)
    assert scene.runner.exits["operator"].code == 0
    assert [hold.pressed for hold in scene.holds[-3:]] == [False] * 3


def test_what_nobody_could_hold_is_refused() -> None:
    assert OperatorParameters(key=48, device="/x").controls == Controls(insert=48)
    for values, said in (
        ({"key": -1}, "key = -1"),
        ({"device": ""}, "device = ''"),
        ({"speed_axis": 2}, "a pedal has none"),
        ({"stop_key": 48}, "not all different"),
        ({"axis_at_zero": 1.0}, "are both 1.0"),
        ({"key": 0x300}, "key"),
        ({"source": "terminal"}, "source"),
    ):
        with pytest.raises(UserError, match=said):
            dataclasses.replace(PEDAL, **values)
