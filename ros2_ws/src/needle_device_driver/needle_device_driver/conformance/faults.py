"""Events that must stop the needle: which rule then counts, and how far the needle may move."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from needle_core import messages as m
from needle_core.component import Action, Call, Publish
from needle_core.messages import HOLD_LIFETIME
from needle_device_driver.axes.capabilities import Capabilities
from needle_device_driver.axes.cycle_times import PERIOD
from needle_device_driver.conformance.rig import DRIVER, ConformanceRig
from needle_device_driver.device import EMERGENCY_STOP
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.limits import SafetyLimits

Travel = tuple[float, float]
Event = Callable[[ConformanceRig], object]
Needs = Callable[[Capabilities], bool]


class Fault(NamedTuple):
    """An event during a motion.

    Attributes
    ----------
    name : str
        Name of the event.
    rule : Rule
        The rule that stops the needle.
    event : callable
        Causes it.
    delay : callable
        Returns the longest time until the drives are ordered to stop, or stop by themselves [s].
    causes : tuple of Rule
        Other rules that may name the cause in the log.
    needs : callable
        Returns whether a drive is able to keep the rule.
    in_steps : bool
        Whether the rule counts in steps only, not in a homing.
    """

    name: str
    rule: Rule
    event: Event
    delay: Delay
    causes: tuple[Rule, ...] = ()
    needs: Needs = lambda _: True
    in_steps: bool = False


# ---- delays -------------------------------------------------------------------------------------

Delay = Callable[[Capabilities, SafetyLimits], float]


def _none(_: Capabilities, __: SafetyLimits) -> float:
    return 0.0


def _hold(_: Capabilities, __: SafetyLimits) -> float:
    return HOLD_LIFETIME + PERIOD


def _answer(drive: Capabilities, _: SafetyLimits) -> float:
    return PERIOD + drive.response_time


def _error(_: Capabilities, limits: SafetyLimits) -> float:
    return limits.insertion_following_error / limits.max_speed + PERIOD


def _silence(_: Capabilities, limits: SafetyLimits) -> float:
    return limits.reply_age_limit + PERIOD


def _order(drive: Capabilities, _: SafetyLimits) -> float:
    return min(drive.longest_order, drive.watchdog)


# ---- events -------------------------------------------------------------------------------------


def _act(action: Action) -> Event:
    return lambda rig: rig.hand.actions.append(action)


def _of(axis: str, name: str, *values: int) -> Event:
    return lambda rig: getattr(rig.behind(axis), name)(axis, *values)


def _unplug(rig: ConformanceRig) -> None:
    for port in rig.drives.connections:
        rig.runner.lose_port(DRIVER, port, "unplugged")


_R = Rule
FAULTS = (
    Fault("release", _R.HOLD_TO_RUN, lambda rig: rig.hold(False), _none, in_steps=True),
    Fault("silent hold", _R.HOLD_AGE, lambda rig: rig.runner.freeze("hand", 0.6), _hold,
          in_steps=True),
    Fault("emergency stop", _R.ESTOP_LATCHES,
          _act(Publish(EMERGENCY_STOP, m.EmergencyStop(True))), _none),
    Fault("device/stop", _R.QUICK_STOP, _act(Call("device/stop")), _none),
    Fault("fault of a drive", _R.ONE_FAULT_STOPS_BOTH, _of("insertion", "fail", 0x2310), _answer,
          (_R.DRIVE_EMERGENCY,)),
    Fault("hot drive", _R.DRIVE_EMERGENCY, _of("rotation", "fail", 0x4210), _answer),
    Fault("blocked axis", _R.FOLLOWING_ERROR, _of("insertion", "stall"), _error,
          (_R.SETTLING_TIME, _R.DRIVE_EMERGENCY), lambda drive: drive.encoder, in_steps=True),
    Fault("hanging drive", _R.REPLY_AGE, _of("rotation", "hang"), _silence),
    Fault("cut line", _R.REPLY_AGE,
          lambda rig: setattr(rig.behind("insertion"), "is_cut", True), _silence),
    Fault("late replies", _R.REPLY_AGE, lambda rig: setattr(rig, "late", 0.2), _silence),
    Fault("unplugged adapter", _R.LINK_LOSS, _unplug, _order),
    Fault("power loss", _R.DRIVE_REBOOT,
          lambda rig: rig.behind("rotation").reboot("rotation", rig.runner.now), _silence,
          (_R.REPLY_AGE,), lambda drive: drive.identity),
    Fault("killed driver", _R.LOOK_AHEAD, lambda rig: rig.runner.kill(DRIVER), _order),
    Fault("frozen driver", _R.DRIVE_WATCHDOG, lambda rig: rig.runner.freeze(DRIVER, 1.0), _order,
          (_R.REPLY_AGE, _R.HOLD_AGE), lambda drive: math.isfinite(drive.watchdog)),
)  # fmt: skip


def largest_travel(fault: Fault, drive: Capabilities, limits: Any) -> Travel:
    """Return how far the motors may move after an event [m], [rad], at the largest speeds.

    Parameters
    ----------
    fault : Fault
        The event.
    drive : Capabilities
        Abilities of the drives.
    limits : DeviceDriverParameters
        The driver's.
    """
    seconds = fault.delay(drive, limits) + PERIOD + drive.response_time
    rows = (
        (limits.max_speed, limits.insertion_quick_stop_deceleration),
        (limits.max_rotation_rate, limits.rotation_quick_stop_deceleration),
    )
    insertion, rotation = (v * seconds + v * v / (2.0 * ramp) for v, ramp in rows)
    return insertion, rotation
