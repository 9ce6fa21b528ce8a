"""Advice on the next step, and the buttons that have an effect."""

from __future__ import annotations

import dataclasses
import enum
import math

from needle_console.view.snapshot import Snapshot, stop_reason
from needle_core.status_messages import ControllerStatus, DeviceStatus

# The needle counts as out if the insertion is smaller than this [m].
_OUT = 1e-4


class Button(enum.Enum):
    """Buttons of the page; the value is the label."""

    CONFIRM = "Confirm needle out"
    HOME = "Home"
    ENABLE = "Enable"
    START = "Start steering"
    INSERT = "Hold to insert"
    RETRACT = "Hold to retract"
    RESET = "Reset"
    SWITCH_OFF = "Switch off"
    STOP = "Stop"


@dataclasses.dataclass(frozen=True)
class Advice:
    """Advice to the person at the page.

    Attributes
    ----------
    headline : str
        Current situation.
    text : str
        Next step.
    button : Button or None
        Button of the next step; None if it requires none.
    """

    headline: str
    text: str
    button: Button | None = None


def advise(snapshot: Snapshot, name: str) -> Advice:  # noqa: PLR0911 - each return is an advice
    """Return the advice for a state of the rig.

    Parameters
    ----------
    snapshot : Snapshot
        State of the rig.
    name : str
        Source of the console's hold.
    """
    device, controller = snapshot.device, snapshot.controller
    if device is None:
        return Advice("No device", "Start device_driver, or sim_rig for a simulated needle.")
    match device.state:
        case "UNCONFIGURED":
            text = stop_reason(device) or "Configure device_driver."
            return Advice("The drives are not set up", text)
        case "ESTOPPED":
            text = "Find the cause. Release the emergency stop and every hold, then press Reset."
            return Advice("Emergency stop", text, Button.RESET)
        case "FAULT":
            text = "Correct the cause, release every hold, then press Reset."
            headline = f"Fault: {stop_reason(device) or 'no reason given'}"
            return Advice(headline, text, Button.RESET)
        case "MOVING":
            return _moving(device)
        case "DISABLED" | "HOLDING" if math.isnan(snapshot.insertion):
            text = "No joint states received: nodes are starting, or have ended."
            return Advice("Waiting for the rig", text)
        case "DISABLED":
            return _disabled(device)
        case "HOLDING":
            steers = controller is not None and controller.is_steering
            if steers and device.press_again == name:
                return Advice("The press is ignored", "Release, then press and hold again.")
            return _holding(snapshot, device)
    return Advice(f"Device: {device.state}", "The console does not know this state.")


def usable_buttons(snapshot: Snapshot) -> frozenset[Button]:
    """Return the buttons that have an effect; *Stop* always has one."""
    device, controller = snapshot.device, snapshot.controller
    if device is None:
        return frozenset()
    if device.state == "DISABLED" and math.isnan(snapshot.insertion):
        return frozenset({Button.RESET})
    steering = controller is not None and controller.is_steering
    found = {
        "DISABLED": {Button.CONFIRM, Button.ENABLE, Button.RESET},
        "HOLDING": {Button.CONFIRM, Button.RETRACT, Button.SWITCH_OFF, Button.RESET},
        "MOVING": {Button.INSERT, Button.RETRACT, Button.SWITCH_OFF},
        "FAULT": {Button.RESET},
        "ESTOPPED": {Button.RESET},
    }.get(device.state, set())
    if device.state == "DISABLED" and device.needle_out_confirmed:
        found.add(Button.HOME)
    if device.state == "HOLDING" and steering:
        found.add(Button.INSERT)
    elif device.state == "HOLDING" and device.homed and controller is not None:
        found.add(Button.START)
    return frozenset(found)


def _moving(device: DeviceStatus) -> Advice:
    if device.activity == "homing":
        return Advice("Homing", "The axes search for their switches. Keep clear; Stop ends it.")
    what = "advances" if device.activity == "step" else "retracts"
    return Advice(f"The needle {what}", "Release to stop it.")


def _disabled(device: DeviceStatus) -> Advice:
    if device.homed:
        return Advice("Ready, switched off", "Switching on does not move anything.", Button.ENABLE)
    if not device.needle_out_confirmed:
        return Advice(
            "Not homed",
            "Confirm if the needle is out of the tissue. If it is in, press Enable and "
            "Hold to retract.",
            Button.CONFIRM,
        )
    return Advice("Not homed", "Homing moves and turns the needle without a hold.", Button.HOME)


def _holding(snapshot: Snapshot, device: DeviceStatus) -> Advice:
    controller = snapshot.controller
    if not device.homed:
        return Advice(
            "Not homed, switched on",
            "Only retraction is possible. When the needle is out: Switch off, confirm, Home.",
            Button.RETRACT,
        )
    if controller is None:
        return Advice("No controller", "Start plane_controller.")
    if controller.is_steering:
        return _steering(controller, device)
    return _not_steering(controller, is_in=snapshot.insertion > _OUT)


def _not_steering(controller: ControllerStatus, *, is_in: bool) -> Advice:
    if controller.state == "DONE":
        return Advice("The depth is reached", "Retract the needle.", Button.RETRACT)
    if controller.state == "FAULT":
        headline = f"Steering failed: {controller.reason}"
        if is_in:
            return Advice(headline, "Retract the needle, then start again.", Button.RETRACT)
        return Advice(headline, "Start again.", Button.START)
    if is_in:
        return Advice(
            "The needle is in the tissue, not steered",
            "Steering begins outside the tissue: retract the needle first.",
            Button.RETRACT,
        )
    return Advice("Ready to steer", "Starting does not move anything yet.", Button.START)


def _steering(controller: ControllerStatus, device: DeviceStatus) -> Advice:
    if controller.state == "WAITING_FOR_TIP":
        return Advice(
            f"The tip is not seen: {controller.reason or 'no reason given'}",
            "Steering waits. Look at the images; Hold to retract is possible.",
        )
    if device.hold_owner:
        return Advice(f"Held by {device.hold_owner}", "The controller computes the next step.")
    return Advice(
        "Steering waits for you",
        "Press and hold to insert (or the space bar); release to stop.",
        Button.INSERT,
    )
