"""Events that must stop the needle, with the rule that stops it and the allowed travel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from needle_core import messages as m
from needle_core.component import Action, Call, Publish
from needle_core.messages import HOLD_LIFETIME
from needle_device_driver.axes.axis import PERIOD
from needle_device_driver.axes.capabilities import Capabilities
from needle_device_driver.conformance.rig import DRIVER, ConformanceRig
from needle_device_driver.device import EMERGENCY_STOP
from needle_device_driver.rules import Rule

Travel = tuple[float, float]
Event = Callable[[ConformanceRig], object]


class Fault(NamedTuple):
    """An event during a motion.

    Attributes
    ----------
    name : str
        Name of the event.
    rule : Rule
        The rule that stops the needle.
    event : callable
        Causes the event.
    delay : str
        Delay until the drives are ordered to stop, or stop by themselves; a key of `_delays`.
    causes : tuple of Rule
        Other rules that may name the cause in the log.
    in_steps : bool
        Whether the rule applies to steps only, not to homing.
    """

    name: str
    rule: Rule
    event: Event
    delay: str
    causes: tuple[Rule, ...] = ()
    in_steps: bool = False


# ---- events -------------------------------------------------------------------------------------


def _act(action: Action) -> Event:
    return lambda rig: rig.hand.actions.append(action)


def _of(axis: str, name: str, *values: int) -> Event:
    return lambda rig: getattr(rig.emulator(axis), name)(axis, *values)


def _unplug(rig: ConformanceRig) -> None:
    for port in rig.drives.connections:
        rig.runner.lose_port(DRIVER, port, "unplugged")


_R = Rule
FAULTS = (
    Fault("release", _R.HOLD_TO_RUN, lambda rig: rig.hold(False), "none", in_steps=True),
    Fault("silent hold", _R.HOLD_AGE, lambda rig: rig.runner.freeze("hand", 0.6), "hold",
          in_steps=True),
    Fault("emergency stop", _R.ESTOP_LATCHES,
          _act(Publish(EMERGENCY_STOP, m.EmergencyStop(True))), "none"),
    Fault("device/stop", _R.QUICK_STOP, _act(Call("device/stop")), "none"),
    Fault("fault of a drive", _R.ONE_FAULT_STOPS_BOTH, _of("insertion", "fail", 0x2310), "answer",
          (_R.DRIVE_EMERGENCY,)),
    Fault("hot drive", _R.DRIVE_EMERGENCY, _of("rotation", "fail", 0x4210), "answer"),
    Fault("blocked axis", _R.FOLLOWING_ERROR, _of("insertion", "stall"), "error",
          (_R.SETTLING_TIME, _R.DRIVE_EMERGENCY), in_steps=True),
    Fault("hanging drive", _R.REPLY_AGE, _of("rotation", "hang"), "silence"),
    Fault("cut line", _R.REPLY_AGE,
          lambda rig: setattr(rig.emulator("insertion"), "is_cut", True), "silence"),
    Fault("late replies", _R.REPLY_AGE, lambda rig: setattr(rig, "late", 0.2), "silence"),
    Fault("unplugged adapter", _R.LINK_LOSS, _unplug, "order"),
    Fault("power loss", _R.DRIVE_REBOOT,
          lambda rig: rig.emulator("rotation").reboot("rotation", rig.runner.now), "silence",
          (_R.REPLY_AGE,)),
    Fault("killed driver", _R.LOOK_AHEAD, lambda rig: rig.runner.kill(DRIVER), "order"),
    Fault("frozen driver", _R.DRIVE_WATCHDOG, lambda rig: rig.runner.freeze(DRIVER, 1.0), "order",
          (_R.REPLY_AGE, _R.HOLD_AGE)),
)  # fmt: skip


_NEEDS = {
    "encoder": (_R.FOLLOWING_ERROR, _R.SETTLING_TIME, _R.AXIS_SPEED),
    "identity": (_R.UNHOMED_OUTWARD_ONLY, _R.DRIVE_REBOOT),
    "switches": (_R.INNER_LIMIT_SWITCH,),
    "has_watchdog": (_R.DRIVE_WATCHDOG, _R.LOOP_HEARTBEAT),
}


def can_satisfy(rule: Rule, drive: Capabilities) -> bool:
    """Return whether drives are able to satisfy a rule."""
    return all(getattr(drive, need) for need, rules in _NEEDS.items() if rule in rules)


def _delays(drive: Capabilities, limits: Any) -> dict[str, float]:
    """Return the longest delay of each kind [s]."""
    return {
        "none": 0.0,
        "hold": HOLD_LIFETIME + PERIOD,
        "answer": PERIOD + drive.response_time,
        "error": limits.insertion_following_error / limits.max_speed + PERIOD,
        "silence": limits.reply_age_limit + PERIOD,
        "order": min(drive.longest_order, drive.watchdog),
    }


def largest_travel(fault: Fault, drive: Capabilities, limits: Any) -> Travel:
    """Return how far the motors may move after an event [m], [rad], at the largest speeds.

    Parameters
    ----------
    fault : Fault
        The event.
    drive : Capabilities
        Abilities of the drives.
    limits : DeviceDriverParameters
        Parameters of the driver.
    """
    seconds = _delays(drive, limits)[fault.delay] + PERIOD + drive.response_time
    rows = (
        (limits.max_speed, limits.insertion_quick_stop_deceleration),
        (limits.max_rotation_rate, limits.rotation_quick_stop_deceleration),
    )
    insertion, rotation = (v * seconds + v * v / (2.0 * ramp) for v, ramp in rows)
    return insertion, rotation
