"""Advice and buttons in each state of the rig."""

from __future__ import annotations

import dataclasses
import itertools

from needle_console.view.advice import Button, advise, usable_buttons
from needle_console.view.snapshot import Snapshot
from needle_core.status_messages import ControllerStatus, DeviceStatus

DISABLED = DeviceStatus(state="DISABLED")
ENABLED = DeviceStatus(state="HOLDING", homed=True)
STEERING = ControllerStatus(state="STEERING")


ADVICE = (
    (Snapshot(), None),
    (Snapshot(DISABLED, insertion=0.0), Button.CONFIRM),
    (
        Snapshot(DeviceStatus(state="DISABLED", needle_out_confirmed=True), insertion=0.0),
        Button.HOME,
    ),
    (Snapshot(DeviceStatus(state="MOVING", activity="homing")), None),
    (Snapshot(DeviceStatus(state="DISABLED", homed=True), insertion=0.0), Button.ENABLE),
    (Snapshot(ENABLED, ControllerStatus(state="IDLE"), insertion=0.0), Button.START),
    (Snapshot(ENABLED, STEERING, insertion=0.0), Button.INSERT),
    (Snapshot(DeviceStatus(state="MOVING", activity="step"), STEERING), None),
    (Snapshot(ENABLED, ControllerStatus(state="DONE"), insertion=0.12), Button.RETRACT),
    (Snapshot(ENABLED, ControllerStatus(state="IDLE"), insertion=0.05), Button.RETRACT),
    (Snapshot(ENABLED, ControllerStatus(state="FAULT"), insertion=0.05), Button.RETRACT),
    (Snapshot(ENABLED, ControllerStatus(state="FAULT"), insertion=0.0), Button.START),
    (Snapshot(DeviceStatus(state="HOLDING"), insertion=0.03), Button.RETRACT),
    (Snapshot(DeviceStatus(state="FAULT", fault="following_error")), Button.RESET),
    (Snapshot(DeviceStatus(state="ESTOPPED")), Button.RESET),
)


def test_advised_buttons_of_a_run() -> None:
    for snapshot, button in ADVICE:
        assert advise(snapshot, "console").button is button, snapshot


def test_advice_names_faults_and_the_hold_owner() -> None:
    waits = ControllerStatus(state="WAITING_FOR_TIP", reason="too dark")
    for snapshot, words in (
        (Snapshot(DeviceStatus(state="FAULT", fault="[reply_age] no reply")), "[reply_age] no rep"),
        (Snapshot(ENABLED, waits, insertion=0.0), "too dark"),
        (Snapshot(dataclasses.replace(ENABLED, hold_owner="pedal"), STEERING, 0.0), "pedal"),
    ):
        assert words in advise(snapshot, "console").headline


def test_ignored_press_is_explained_to_its_source() -> None:
    device = dataclasses.replace(ENABLED, press_again="console")
    snapshot = Snapshot(device, STEERING, insertion=0.01)
    assert "press and hold again" in advise(snapshot, "console").text
    assert "press and hold again" not in advise(snapshot, "pedal").text


def test_every_state_has_advice_with_a_usable_button() -> None:
    states = ("UNCONFIGURED", "DISABLED", "HOLDING", "MOVING", "FAULT", "ESTOPPED", "NEW")
    steered = ("IDLE", "STEERING", "WAITING_FOR_TIP", "DONE", "FAULT")
    controllers = (None, *(ControllerStatus(state=state) for state in steered))
    booleans = (False, True)
    for state, controller, homed, out in itertools.product(states, controllers, booleans, booleans):
        device = DeviceStatus(state=state, homed=homed, needle_out_confirmed=out)
        snapshot = Snapshot(device, controller, insertion=0.03)
        advice = advise(snapshot, "console")
        assert advice.headline
        assert advice.text
        assert advice.button is None or advice.button in usable_buttons(snapshot), snapshot
