"""Events that must stop the needle: which rule then counts, and how far the needle may move."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from needle_core import messages as m
from needle_core.component import Call, Publish
from needle_core.messages import HOLD_LIFETIME
from needle_device_driver.axes.capabilities import Capabilities
from needle_device_driver.axes.cycle_times import PERIOD
from needle_device_driver.conformance.rig import DRIVER, ConformanceRig, Held
from needle_device_driver.device import EMERGENCY_STOP
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.limits import SafetyLimits

Travel = tuple[float, float]
Event = Callable[[ConformanceRig], object]
Delay = Callable[[Capabilities, SafetyLimits], float]
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


def _at_once(_: Capabilities, __: SafetyLimits) -> float:
    return 0.0


def _next_answer(drive: Capabilities, _: SafetyLimits) -> float:
    return PERIOD + drive.response_time


def _silence(_: Capabilities, limits: SafetyLimits) -> float:
    return limits.reply_age_limit + PERIOD


def _by_itself(drive: Capabilities, _: SafetyLimits) -> float:
    return min(drive.longest_order, drive.watchdog)


def _lose_ports(rig: ConformanceRig) -> None:
    for port in rig.drives.connections:
        rig.runner.lose_port(DRIVER, port, "unplugged")


FAULTS = (
    Fault(
        "release",
        Rule.HOLD_TO_RUN,
        lambda rig: setattr(rig.hand, "held", Held(False)),
        _at_once,
        in_steps=True,
    ),
    Fault(
        "silent hold",
        Rule.HOLD_AGE,
        lambda rig: rig.runner.freeze(rig.hand.name, 0.6),
        lambda _, __: HOLD_LIFETIME + PERIOD,
        in_steps=True,
    ),
    Fault(
        "emergency stop",
        Rule.ESTOP_LATCHES,
        lambda rig: rig.hand.actions.append(Publish(EMERGENCY_STOP, m.EmergencyStop(True))),
        _at_once,
    ),
    Fault(
        "device/stop",
        Rule.QUICK_STOP,
        lambda rig: rig.hand.actions.append(Call("device/stop")),
        _at_once,
    ),
    Fault(
        "fault of the insertion drive",
        Rule.ONE_FAULT_STOPS_BOTH,
        lambda rig: rig.behind("insertion").fail("insertion", 0x2310),
        _next_answer,
        (Rule.DRIVE_EMERGENCY,),
    ),
    Fault(
        "fault of the rotation drive",
        Rule.DRIVE_EMERGENCY,
        lambda rig: rig.behind("rotation").fail("rotation", 0x4210),
        _next_answer,
    ),
    Fault(
        "blocked axis",
        Rule.FOLLOWING_ERROR,
        lambda rig: rig.behind("insertion").stall("insertion"),
        lambda _, limits: limits.insertion_following_error / limits.max_speed + PERIOD,
        (Rule.SETTLING_TIME,),
        needs=lambda drive: drive.encoder,
        in_steps=True,
    ),
    Fault(
        "hanging drive",
        Rule.REPLY_AGE,
        lambda rig: rig.behind("rotation").hang("rotation"),
        _silence,
    ),
    Fault(
        "cut line",
        Rule.REPLY_AGE,
        lambda rig: setattr(rig.behind("insertion"), "is_cut", True),
        _silence,
    ),
    Fault("late replies", Rule.REPLY_AGE, lambda rig: setattr(rig, "late", 0.2), _silence),
    Fault("unplugged adapter", Rule.LINK_LOSS, _lose_ports, _by_itself),
    Fault(
        "power loss of a drive",
        Rule.DRIVE_REBOOT,
        lambda rig: rig.behind("rotation").reboot("rotation", rig.runner.now),
        _silence,
        (Rule.REPLY_AGE,),
        needs=lambda drive: drive.identity,
    ),
    Fault("killed driver", Rule.LOOK_AHEAD, lambda rig: rig.runner.kill(DRIVER), _by_itself),
    Fault(
        "frozen driver",
        Rule.DRIVE_WATCHDOG,
        lambda rig: rig.runner.freeze(DRIVER, 1.0),
        _by_itself,
        (Rule.REPLY_AGE, Rule.HOLD_AGE),
        needs=lambda drive: math.isfinite(drive.watchdog),
    ),
)


def largest_travel(fault: Fault, rig: ConformanceRig) -> Travel:
    """Return how far the motors may move after an event [m], [rad], at the largest speeds."""
    limits, drive = rig.settings, rig.capabilities
    seconds = fault.delay(drive, limits) + PERIOD + drive.response_time
    rows = (
        (limits.max_speed, limits.insertion_quick_stop_deceleration),
        (limits.max_rotation_rate, limits.rotation_quick_stop_deceleration),
    )
    insertion, rotation = (v * seconds + v * v / (2.0 * ramp) for v, ramp in rows)
    return insertion, rotation
