"""Scenarios of the rules that depend on the drives."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Any

from needle_core.component import Call
from needle_device_driver.axes.axis import PERIOD, AxisError
from needle_device_driver.axes.capabilities import Capabilities
from needle_device_driver.conformance import checks
from needle_device_driver.conformance.faults import FAULTS, Fault, can_satisfy, largest_travel
from needle_device_driver.conformance.rig import AXES, DRIVER, ConformanceRig
from needle_device_driver.device_driver import DeviceDriver
from needle_device_driver.rules import Rule

Travel = tuple[float, float]
MakeRig = Callable[..., ConformanceRig]
"""Makes a rig with the drives under test; keywords `driver` and `drives` are parameters."""
NO_TRAVEL = (0.0, 0.0)
IMPOSSIBLE = "not possible"
# Longest time after a fault until nothing moves and the driver has logged the cause [s].
_STOPPED = 1.5
_DEEP, _SHALLOW = 0.1, 0.02
_RETRACT_AT = 0.003
# Motion ordered by another computer until detection [m].
_INTRUSION = 0.001
# Constant delay of replies that only slows a motion down [s].
_LATE = 0.03


def random_moment(fault: Fault, make: MakeRig, seed: int) -> None:
    """Cause a fault at a random moment of set-up, homing, steps or rest."""
    rng, rig = random.Random(seed), make(drives={"insertion_start": 0.002})
    moment = rng.uniform(0.1, 6.0)
    moves = ("step", "retraction")
    while rig.runner.now < moment or (fault.in_steps and rig.hand.status.activity not in moves):
        _proceed(rig)
        rig.runner.run(PERIOD * rng.random())
    _stop_by(fault, rig)


def _proceed(rig: ConformanceRig) -> None:
    """Take the next action towards a step or retraction."""
    status = rig.hand.status
    match status.state, status.homed, status.activity:
        case "DISABLED", False, _:
            rig.hand.actions += [Call("device/confirm_needle_out", True), Call("device/home")]
        case "DISABLED", True, _:
            rig.hand.actions += [Call("device/enable", True)]
        case "HOLDING", True, _ if status.hold_owner != "hand":
            rig.press()
        case "HOLDING", True, _ if (status.insertion_m or 0.0) > _RETRACT_AT:
            rig.hand.actions += [Call("device/retract")]
            rig.runner.run(0.1)
        case "HOLDING", True, _:
            rig.step(duration=checks.STEP_TIME)


def _stop_by(fault: Fault, rig: ConformanceRig) -> None:
    """Cause a fault: the motors stop in time, the cause is logged, and nothing moves later."""
    activity = rig.hand.status.activity
    travel = rig.travel(lambda: fault.event(rig), _STOPPED)
    bound = largest_travel(fault, rig.capabilities, rig.settings)
    assert travel[0] <= bound[0] and travel[1] <= bound[1], f"{travel} > {bound}, {rig.logged}"
    assert rig.is_at_rest(), rig.logged
    if activity != "none" and rig.state in ("FAULT", "ESTOPPED"):
        assert any(map(rig.is_logged, (fault.rule, *fault.causes))), rig.logged
    if activity == "step" and rig.runner.runs(DRIVER):
        assert rig.commands[-1] in rig.hand.results, rig.logged
    assert _later_motion(rig) == NO_TRAVEL, rig.logged


def _later_motion(rig: ConformanceRig) -> Travel:
    """Remove the cause, press, reset and switch on; return how far the motors move."""
    begin = rig.positions
    rig.late = 0.0
    for port, drives in rig.drives.connections.items():
        drives.restore(rig.runner.now)
        rig.runner.open_port(DRIVER, port)
    if not rig.runner.runs(DRIVER):
        rig.runner.start(DeviceDriver(rig.settings))
    for name, request in ((None, None), ("reset", None), ("enable", True), ("enable", False)):
        rig.hand.actions += [Call(f"device/{name}", request)] if name else []
        for pressed in (False, True):
            rig.hold(pressed)
            rig.runner.run(0.25)
    return rig.distance(begin)


# ---- other rules --------------------------------------------------------------------------------


def no_motion_by_itself(make: MakeRig) -> None:
    """Set up, reconnect, reset, switch on and off, also after a step: nothing moves.

    The drives are off after set-up and after the driver ends.
    """
    rig = make(drives={"insertion_start": 0.01})
    begin = rig.positions
    was_off = False
    while rig.state != "DISABLED":
        rig.runner.run(PERIOD / 4.0)
        # A drive may be on from its power-up until its set-up.
        is_off = checks.are_switched_off(rig)
        assert is_off or not was_off
        was_off = is_off
    rig.call("device/confirm_needle_out", True)
    for port in rig.drives.connections:
        rig.runner.lose_port(DRIVER, port, "unplugged")
    rig.runner.run(0.5)
    assert _later_motion(rig) == NO_TRAVEL
    assert rig.distance(begin) == NO_TRAVEL
    rig = make()
    rig.moving(checks.STEP_TIME)
    rig.call("device/enable", False)
    rig.runner.run(0.1)
    assert _later_motion(rig) == NO_TRAVEL
    rig = make()
    rig.ready()
    rig.runner.kill(DRIVER)
    rig.runner.start(DeviceDriver(rig.settings))
    rig.runner.run(2.0)
    assert checks.are_switched_off(rig, "FAULT")
    rig = make()
    rig.ready()
    rig.runner.stop(DRIVER)
    # The first run returns when the driver ends.
    rig.until(lambda: not rig.runner.runs(DRIVER), "the end of the driver")
    rig.runner.run(1.0)
    assert checks.are_switched_off(rig)


def drive_emergency(make: MakeRig) -> None:
    """Reset a drive after a fault: the next step ends at its target."""
    rig = make()
    rig.ready()
    rig.emulator("insertion").fail("insertion", 0x2310)
    assert rig.fails(Rule.DRIVE_EMERGENCY)
    rig.release()
    rig.call("device/reset")
    rig.call("device/enable", True)
    rig.press()
    checks.check_step(rig)


def reply_age(make: MakeRig) -> None:
    """Step at nearly the largest speed, also with late replies: it ends at its target."""
    rig = make()
    rig.ready()
    for rig.late in (0.0, _LATE):
        checks.check_step(rig)


def quick_stop(make: MakeRig) -> None:
    """Release while an axis is blocked, and free it: it does not move to the old target.

    A stop also ends an order that lasts longer than a cycle.
    """
    assert checks.order_directly(make, stops=True) < checks.TIGHT
    rig = make()
    rig.moving(checks.STEP_TIME)
    rig.emulator("insertion").stall("insertion")
    rig.runner.run(0.04)
    rig.release()
    begin = rig.positions
    rig.emulator("insertion").restore(rig.runner.now)
    rig.runner.run(0.5)
    assert rig.distance(begin) == NO_TRAVEL


def retraction(make: MakeRig) -> None:
    """Retract: it needs the hold, moves the insertion axis only, and ends at 0."""
    rig = make()
    stamp = rig.moving(checks.STEP_TIME)
    rig.until(lambda: stamp in rig.hand.results, "the end of the step")
    begin = rig.positions
    rig.call("device/retract")
    rig.until(lambda: rig.positions[0] < begin[0] - 0.0005, "the retraction")
    travel = rig.travel(rig.release, 0.5)
    assert travel[0] < 0.001
    assert rig.is_at_rest()
    rig.press()
    assert rig.is_at_rest()
    rig.call("device/retract")
    rig.until(lambda: rig.hand.status.activity == "none", "the end of the retraction")
    rig.runner.run(0.5)
    assert abs(rig.positions[0]) < 1e-4
    assert rig.distance((rig.positions[0], begin[1])) == NO_TRAVEL


def unhomed_outward_only(make: MakeRig) -> None:
    """Restart a drive: the needle moves outwards only, by its last insertion."""
    rig = make()
    stamp = rig.moving(checks.STEP_TIME)
    rig.until(lambda: stamp in rig.hand.results, "the end of the step")
    deep = rig.positions[0]
    rig.emulator("insertion").reboot("insertion", rig.runner.now)
    rig.runner.run(1.0)
    assert not rig.hand.status.homed
    rig.release()
    rig.call("device/reset")
    rig.call("device/enable", True)
    rig.press()
    rig.step()
    assert rig.is_logged(Rule.HOMED_FIRST)
    assert rig.is_at_rest()
    rig.call("device/retract")
    rig.until(lambda: rig.hand.status.activity == "none", "the end of the retraction")
    assert -1e-4 < rig.positions[0] < 0.1 * deep


def homing_time(make: MakeRig) -> None:
    """Home towards a switch that is too far away: the homing ends."""
    rig = make(driver={"max_depth": _SHALLOW}, drives={"insertion_start": _DEEP})
    rig.begin_homing()
    rig.until(lambda: rig.state == "FAULT", "the end of a homing")
    assert _DEEP - rig.positions[0] < 1.25 * _SHALLOW
    assert rig.fails(Rule.HOMING_TIME)


def inner_limit_switch(make: MakeRig) -> None:
    """Step onto the inner limit switch: the step ends."""
    rig = make(drives={"insertion_travel": 0.0015})
    rig.moving(checks.STEP_TIME)
    rig.runner.run(1.0)
    assert rig.fails(Rule.INNER_LIMIT_SWITCH)
    assert rig.positions[0] < 0.0015 + 0.0005


def settling_time(make: MakeRig) -> None:
    """Block the axis shortly before its target: the step ends."""
    rig = make()
    rig.moving(checks.STEP_TIME)
    rig.until(lambda: rig.positions[0] > 0.0018, "the step's end")
    rig.emulator("insertion").stall("insertion")
    rig.runner.run(1.5)
    assert rig.fails(Rule.SETTLING_TIME)


def axis_speed(make: MakeRig) -> None:
    """Home with a motor three times as fast as ordered: it stops within 8 mm."""
    rig = make(drives={"insertion_start": _DEEP, "insertion_max_speed": 0.15})
    motor = rig.emulator("insertion").motors["insertion"]
    follow, last = motor.follow, [motor.position]

    def follow_too_fast(demand: float, period: float) -> None:
        ordered, last[0] = demand - last[0], demand
        follow(motor.position + 3.0 * ordered, period)

    motor.follow = follow_too_fast
    rig.begin_homing()
    rig.runner.run(2.0)
    assert rig.fails(Rule.AXIS_SPEED) or rig.fails(Rule.FOLLOWING_ERROR)
    assert abs(_DEEP - rig.positions[0]) < 0.008


def software_limits(make: MakeRig) -> None:
    """Order a set-point beyond the limits: both the driver and the drive refuse it."""
    rig = make()
    if rig.capabilities.limits:
        assert checks.order_directly(make, stops=False) < 2.0 * checks.TIGHT
    rig.home()
    rig.runner.run(0.5)
    for axis, beyond in zip(AXES, (-0.002, 100.0), strict=True):
        try:
            rig.axis(axis).start_move(beyond, 0.001)
        except AxisError as refused:
            assert refused.rule is Rule.SOFTWARE_LIMITS
        else:
            raise AssertionError(f"{axis} axis accepts {beyond:g}")


def one_master(make: MakeRig) -> None:
    """Interfere as another computer at rest: the driver detects it."""
    rig = make()
    rig.ready()
    begin = rig.positions
    if rig.emulator("insertion").intrude():
        assert rig.fails(Rule.ONE_MASTER) or rig.fails(Rule.AXIS_SPEED), rig.logged
        assert abs(rig.positions[0] - begin[0]) < _INTRUSION


def drive_reboot(make: MakeRig) -> None:
    """Restart a drive before the driver misses a reply: it is no longer homed."""
    rig = make(drives={"boot_time": 0.05})
    rig.ready()
    drives = rig.emulator("rotation")
    drives.boot_time = 0.05
    drives.reboot("rotation", rig.runner.now)
    rig.runner.run(0.5)
    assert rig.fails(Rule.DRIVE_REBOOT) or rig.fails(Rule.REPLY_AGE)
    assert not rig.hand.status.homed


def drive_watchdog(make: MakeRig) -> None:
    """Kill the driver: the drives fault or switch off."""
    rig = make()
    rig.moving(checks.STEP_TIME)
    rig.runner.kill(DRIVER)
    _check_stopped(rig)


def loop_heartbeat(make: MakeRig) -> None:
    """Hang the loop of the driver at rest: the drives fault or switch off."""
    rig = make()
    rig.ready()
    rig.runner.run(1.0)
    assert rig.state == "HOLDING"
    rig.runner.freeze(DRIVER, 0.5)
    _check_stopped(rig)


def _check_stopped(rig: ConformanceRig) -> None:
    rig.runner.run(0.4)
    assert checks.are_switched_off(rig, "FAULT")


SCENARIOS: dict[Rule, Callable[[MakeRig], None]] = {
    Rule(scenario.__name__): scenario
    for scenario in (
        *(no_motion_by_itself, retraction, unhomed_outward_only, homing_time, inner_limit_switch),
        *(settling_time, axis_speed, software_limits, quick_stop, one_master, drive_reboot),
        *(drive_emergency, reply_age),
        *(drive_watchdog, loop_heartbeat),
    )
}
"""Scenario of each rule."""
RULES = tuple(rule for rule in Rule if rule in {*SCENARIOS, *(fault.rule for fault in FAULTS)})
"""Rules that depend on the drives."""


def verdict(rule: Rule, drive: Capabilities, limits: Any) -> str:
    """Return how drives satisfy a rule: fully, by the driver alone, within a bound, or not at all.

    Parameters
    ----------
    rule : Rule
        One of `RULES`.
    drive : Capabilities
        Abilities of the drives.
    limits : DeviceDriverParameters
        Parameters of the driver.
    """
    faults = (fault for fault in FAULTS if fault.rule is rule)
    if not can_satisfy(rule, drive):
        return IMPOSSIBLE
    if rule is Rule.SOFTWARE_LIMITS and not drive.limits:
        return "driver only"
    bound = max((largest_travel(fault, drive, limits)[0] for fault in faults), default=0.0)
    if rule is Rule.ONE_MASTER and not drive.exclusive:
        bound = _INTRUSION
    # Rounded up.
    return f"within {math.ceil(bound * 1e5 - 1e-6) / 100:.2f} mm" if bound else "enforced"


def check_rule(rule: Rule, make: MakeRig) -> None:
    """Run the scenarios of a rule; the motors stay within the stated bounds."""
    for fault in FAULTS:
        if fault.rule is rule:
            rig = make()
            rig.moving(checks.STEP_TIME)
            _stop_by(fault, rig)
    if rule in SCENARIOS:
        SCENARIOS[rule](make)
