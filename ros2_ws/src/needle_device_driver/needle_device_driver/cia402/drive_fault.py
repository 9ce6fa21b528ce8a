"""Fault of a drive, and the rule behind it."""

from __future__ import annotations

from needle_device_driver.cia402.axis_speed import SpeedWatch
from needle_device_driver.cia402.cia402 import FAULTS, FOLLOWING_ERROR
from needle_device_driver.cia402.drive_machine import DriveMachine
from needle_device_driver.cia402.drive_monitor import DriveMonitor
from needle_device_driver.cia402.homing_run import HomingRun, HomingStep
from needle_device_driver.link.emergency import HEARTBEAT_LOST, describe_error
from needle_device_driver.rules import Rule

Fault = tuple[Rule, str]


def drive_fault(  # noqa: PLR0911 - each return is a fault
    monitor: DriveMonitor,
    machine: DriveMachine,
    speed: SpeedWatch,
    homing: HomingRun | None,
    *,
    actuated: bool,
) -> Fault | None:
    """Return the first thing that is wrong with a drive, in words, and its rule.

    Parameters
    ----------
    monitor : DriveMonitor
        What the drive sent by itself.
    machine : DriveMachine
        What it was led to.
    speed : SpeedWatch
        How fast its axis is.
    homing : HomingRun or None
        A homing under way.
    actuated : bool
        Whether the drive moves anything; one that does not may be in any state.
    """
    if speed.trouble:
        return Rule.AXIS_SPEED, speed.trouble
    if monitor.rebooted:
        return Rule.DRIVE_REBOOT, "the drive rebooted; its home position is lost"
    code = monitor.emergency
    if code is not None:
        rule = Rule.DRIVE_WATCHDOG if code == HEARTBEAT_LOST else Rule.DRIVE_EMERGENCY
        return rule, f"the drive reports {describe_error(code)}"
    state = machine.state
    if actuated and state is not None and state in FAULTS:
        return Rule.DRIVE_EMERGENCY, f"the drive is in {state.name}"
    if monitor.left_operational:
        return Rule.DRIVE_REBOOT, "the drive left the operational state"
    if machine.trouble:
        return Rule.ONE_FAULT_STOPS_BOTH, f"the drive {machine.trouble}"
    if homing is not None and homing.trouble:
        failed = homing.step is HomingStep.FAILED
        rule = Rule.ONE_FAULT_STOPS_BOTH if failed else Rule.HOMING_TIME
        return rule, f"the drive {homing.trouble}"
    if machine.ready and machine.at.statusword & FOLLOWING_ERROR:
        return Rule.FOLLOWING_ERROR, "the drive reports a following error"
    return None
