"""Tells moments of a run, by what is heard of the rig."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from scenario.faults import Moment
from scenario.rig import SoakRig

# What it is when a field of a status becomes another.
_DEVICE = {
    ("activity", "homing"): Moment.HOMING,
    ("state", "HOLDING"): Moment.HOLDING,
    ("state", "MOVING"): Moment.MOVING,
    ("state", "FAULT"): Moment.FAULT,
}
_CONTROLLER = {("state", "STEERING"): Moment.STEERING, ("state", "DONE"): Moment.DONE}


def watch_moments(rig: SoakRig, meet: Callable[[Moment], None]) -> None:
    """Call `meet` with each moment of a rig as it comes, the start at once."""
    heard: dict[str, Any] = {}

    def watch_status(topic: str, moments: dict[tuple[str, str], Moment]) -> None:
        def see(_: str, message: Any) -> None:
            before = heard.get(topic)
            heard[topic] = message
            for (key, value), moment in moments.items():
                if getattr(message, key) == value != getattr(before, key, ""):
                    meet(moment)

        rig.watch(topic, see)

    def see_hold(node: str, message: Any) -> None:
        if node != rig.hand_node:
            return
        pressed = heard.get(node, False)
        heard[node] = message.pressed
        if message.pressed != pressed:
            meet(Moment.PRESSED if message.pressed else Moment.RELEASED)

    watch_status("device/status", _DEVICE)
    watch_status("needle/controller_status", _CONTROLLER)
    rig.watch("device/hold", see_hold)
    rig.watch("device/joint_trajectory", lambda *_: meet(Moment.COMMAND))
    rig.adapter_opened.append(lambda: meet(Moment.ADAPTER_OPENED))
    meet(Moment.START)
