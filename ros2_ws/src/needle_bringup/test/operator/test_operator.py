"""The operator as a component: input of a person becomes the hold, calls and log lines."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

import pytest

from needle_bringup.operator.component import INPUT_DEVICE, Operator
from needle_bringup.operator.hold_debouncer import InputLost, InputReading, InputState
from needle_bringup.operator.parameters import PERIOD, OperatorParameters
from needle_core import messages as m
from needle_core.component import (
    Action,
    Answer,
    Call,
    Diagnose,
    Exit,
    Log,
    Moment,
    Peers,
    Publish,
    Send,
)
from needle_core.errors import UserError
from needle_core.retraction import BEGINS_WITHIN, RETRACT, STOP_STEERING
from needle_core.status_messages import ControllerStatus, DeviceStatus

PEDAL = OperatorParameters(device="/dev/input/pedal", key=48, retract_key=49, stop_key=50)
JOYSTICK = OperatorParameters(source="joy", key=0, retract_key=1, stop_key=2, speed_axis=0)
STOP = "device/stop"
NEUTRAL, OUT = InputState(), InputState(retract=True)


class Scene:
    """Operator with an input device, in a rig that accepts all calls."""

    def __init__(self, settings: OperatorParameters) -> None:
        self.operator = Operator(settings)
        self.now = 10.0
        self.holds: list[m.HoldState] = []
        self.called: list[str] = []
        self.logs: list[str] = []
        self.accepts = True
        peers = Peers({"joy": ("joy_node",), "needle/controller_status": ("plane_controller",)})
        self.execute(self.operator.on_peers(peers, self.at))

    @property
    def at(self) -> Moment:
        return Moment(self.now, round(self.now * 1e9))

    def execute(self, actions: Iterable[Action]) -> None:
        for action in actions:
            if isinstance(action, Publish):
                self.holds.append(action.message)
            elif isinstance(action, Log):
                self.logs.append(action.text)
            elif isinstance(action, Call):
                self.called.append(action.service)
                answer = Answer(action.service, self.accepts, "not now")
                self.execute(self.operator.on_answer(answer, self.at))
            else:
                assert isinstance(action, Diagnose)

    def update(self, reading: InputReading = NEUTRAL, **status: Any) -> m.HoldState:
        """Handle a device status, then a reading of the port."""
        self.now += PERIOD
        (row, _), (port,) = self.operator.inputs, self.operator.ports
        if status:
            self.execute(row.handler(DeviceStatus(**status), self.at))
        self.execute(port.handler((InputLost("an older reading"), reading), self.at))
        return self.holds[-1]

    def steer(self, state: str) -> None:
        """Handle a status of the controller."""
        self.execute(self.operator.inputs[1].handler(ControllerStatus(state=state), self.at))

    def joy(self, *down: int, silent: bool = False) -> m.HoldState:
        """Handle a joystick message, then run the timer."""
        self.now += 0.2 if silent else PERIOD
        buttons = tuple(int(button in down) for button in range(3))
        if not silent:
            message = m.Joystick(self.at.stamp_ns, (0.6,), buttons)
            self.execute(self.operator.inputs[-1].handler(message, self.at))
        self.execute(self.operator.timers[0].handler(self.at))
        return self.holds[-1]


def test_a_pedal_is_held_until_it_is_lost() -> None:
    scene = Scene(PEDAL)
    assert not scene.update().pressed
    held = scene.update(InputState(insert=True, speed=0.5))
    assert (held.source, held.pressed, held.speed_scale) == ("operator", True, 0.5)
    assert held.lifetime == m.HOLD_LIFETIME
    scene.update(InputState(insert=True), press_again="operator")
    assert "the device ignores this press" in scene.logs[-1]
    assert not scene.update(InputLost("unplugged")).pressed
    assert scene.logs[-1] == "nothing is held: unplugged"
    for _ in range(2):
        assert not scene.update(InputState(insert=True)).pressed
    # An unchanged state is logged once.
    assert [text for text in scene.logs if "the press is ignored" in text] == scene.logs[-1:]
    assert [hold.count for hold in scene.holds] == list(range(1, len(scene.holds) + 1))
    assert len({hold.session for hold in scene.holds}) == 1


def test_a_joystick_holds_sets_the_speed_stops_and_times_out() -> None:
    scene = Scene(JOYSTICK)
    # A press from before the start does not count.
    assert not scene.joy(0).pressed
    scene.joy()
    assert scene.joy(0).pressed
    assert scene.holds[-1].speed_scale == pytest.approx(0.8)
    assert not scene.joy(0, 2).pressed
    assert not scene.joy(0).pressed
    scene.joy()
    assert scene.joy(0).pressed
    assert not scene.joy(silent=True).pressed
    assert not scene.joy(0).pressed
    assert scene.called == [STOP]


def test_the_controller_is_stopped_before_a_withdrawal() -> None:
    scene = Scene(PEDAL)
    scene.update()
    scene.steer("STEERING")
    assert not scene.update(OUT).pressed
    assert scene.called == [STOP_STEERING]
    scene.steer("IDLE")
    assert scene.update(OUT).pressed
    assert scene.logs[-1] == "held to withdraw the needle"
    scene.update(OUT, hold_owner="operator")
    assert scene.called == [STOP_STEERING, RETRACT]
    assert scene.update(OUT, hold_owner="operator", activity="retraction").pressed
    scene.now += BEGINS_WITHIN
    assert not scene.update(OUT, hold_owner="operator").pressed


def test_an_ended_controller_does_not_prevent_a_withdrawal() -> None:
    scene = Scene(PEDAL)
    scene.update()
    scene.steer("STEERING")
    scene.execute(scene.operator.on_peers(Peers(), scene.at))
    assert scene.update(OUT).pressed


def test_a_refused_withdrawal_is_reported_until_the_release() -> None:
    scene = Scene(PEDAL)
    scene.update()
    scene.accepts = False
    scene.update(OUT, hold_owner="operator")
    assert scene.logs[-1] == "not withdrawn: device/retract: not now"
    scene.update()
    assert scene.logs[-1] == "nothing is held"


def test_a_new_speed_is_applied_and_the_end_releases() -> None:
    operator, at = Operator(PEDAL), Moment(1.0, 1)
    faster = dataclasses.replace(PEDAL, speed_scale=0.25)
    assert list(operator.on_settings(faster, at)) == [Send(INPUT_DEVICE, (0.25,))]
    *releases, end = operator.on_stop(at)
    assert [r.message.pressed for r in releases if isinstance(r, Publish)] == [False] * 3
    assert end == Exit(0)


def test_invalid_parameters_are_rejected() -> None:
    refused: tuple[tuple[dict[str, Any], str], ...] = (
        ({"device": ""}, "device = ''"),
        ({"speed_axis": 2}, "a pedal has none"),
        ({"stop_key": 48}, "not all different"),
        ({"axis_at_zero": 1.0}, "are both 1.0"),
    )
    for values, cause in refused:
        with pytest.raises(UserError, match=cause):
            dataclasses.replace(PEDAL, **values)
