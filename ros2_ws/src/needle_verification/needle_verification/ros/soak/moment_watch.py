"""Tells moments of a run, by what is heard of the rig."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from needle_core.ros.conversions import values_of
from needle_verification.ros.soak.virtual_rig import VirtualRig
from needle_verification.soak.faults import Moment

# What it is when a value of a status becomes another.
_DEVICE = {
    ("activity", "homing"): Moment.HOMING,
    ("state", "HOLDING"): Moment.HOLDING,
    ("state", "MOVING"): Moment.MOVING,
    ("state", "FAULT"): Moment.FAULT,
}
_CONTROLLER = {("state", "STEERING"): Moment.STEERING, ("state", "DONE"): Moment.DONE}


def watch_moments(rig: VirtualRig, meet: Callable[[Moment], None]) -> None:
    """Call `meet` with each moment of a rig as it comes, the start at once."""
    heard: dict[str, Any] = {}

    def watch_status(topic: str, moments: dict[tuple[str, str], Moment]) -> None:
        def see(_: str, message: Any) -> None:
            values = values_of(message)
            before = heard.get(topic, {})
            heard[topic] = values
            for (key, value), moment in moments.items():
                if values.get(key) == value != before.get(key):
                    meet(moment)

        rig.graph.watch(topic, see)

    def see_hold(node: str, message: Any) -> None:
        if node != rig.hand_node:
            return
        presses, pressed = any(message.buttons), heard.get(node, False)
        heard[node] = presses
        if presses != pressed:
            meet(Moment.PRESSED if presses else Moment.RELEASED)

    watch_status("/device/status", _DEVICE)
    watch_status("/needle/controller_status", _CONTROLLER)
    rig.graph.watch("/device/hold", see_hold)
    rig.graph.watch("/device/joint_trajectory", lambda *_: meet(Moment.COMMAND))
    rig.can.watchers.append(lambda: meet(Moment.ADAPTER_OPENED))
    meet(Moment.START)
