"""The device's messages, to and from plain data."""

from __future__ import annotations

import math

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import JointState, Joy
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory

from needle_common.diagnostics import Diagnostic, Level
from needle_common.ros.conversions import to_diagnostic_status, to_nanoseconds, to_stamp
from needle_device_driver.axes.axis_pair import PairSnapshot
from needle_device_driver.supervisor.command import (
    INSERTION_JOINT,
    ROTATION_JOINT,
    Command,
    CommandPoint,
)
from needle_device_driver.supervisor.hold import HoldMessage
from needle_device_driver.supervisor.reports import DeviceStatus, StepResult
from needle_device_driver.supervisor.states import State

_LEVELS = {State.FAULT: Level.ERROR, State.ESTOPPED: Level.ERROR, State.UNCONFIGURED: Level.WARN}


def to_command(message: JointTrajectory) -> Command:
    """Return a trajectory as it came, nothing checked."""
    return Command(
        stamp_ns=to_nanoseconds(message.header.stamp),
        joint_names=tuple(message.joint_names),
        points=tuple(
            CommandPoint(
                positions=tuple(point.positions),
                others=(*point.velocities, *point.accelerations, *point.effort),
                time_from_start=point.time_from_start.sec + point.time_from_start.nanosec * 1e-9,
            )
            for point in message.points
        ),
    )


def to_hold_message(message: Joy) -> HoldMessage:
    """Return a hold message; one without button or axis is a release."""
    return HoldMessage(
        sender=message.header.frame_id,
        stamp_ns=to_nanoseconds(message.header.stamp),
        pressed=len(message.buttons) > 0 and message.buttons[0] == 1,
        speed_scale=float(message.axes[0]) if len(message.axes) > 0 else math.nan,
        lifetime=float(message.axes[1]) if len(message.axes) > 1 else math.inf,
    )


def to_joint_state(joints: PairSnapshot, stamp: Time) -> JointState:
    """Return measured joints as a message."""
    message = JointState(
        name=[INSERTION_JOINT, ROTATION_JOINT],
        position=[joints.insertion.position, joints.rotation.position],
        velocity=[joints.insertion.velocity, joints.rotation.velocity],
    )
    message.header.stamp = stamp
    return message


def to_result(result: StepResult) -> Header:
    """Return the end of a step as a message."""
    return Header(stamp=to_stamp(result.stamp_ns), frame_id=result.outcome)


def to_diagnostic(status: DeviceStatus) -> Diagnostic:
    """Return the device's status as a line of health."""
    message = status.fault or status.reason or status.state.value
    return Diagnostic(
        _LEVELS.get(status.state, Level.OK),
        message,
        {
            "state": status.state.value,
            "activity": status.activity.value,
            "homed": "true" if status.homed else "false",
            "hold_owner": status.hold_owner,
            "press_again": status.press_again,
            "speed_scale": f"{status.speed_scale:.3g}",
            "insertion_m": "" if status.insertion is None else repr(status.insertion),
            "rotation_rad": "" if status.rotation is None else repr(status.rotation),
            "fault": status.fault,
            "reason": status.reason,
            "needle_out_confirmed": "true" if status.needle_out_confirmed else "false",
            "watchdog_trips": str(status.watchdog_trips),
            "commands_refused": str(status.commands_refused),
            "needs_time": "true" if status.needs_time else "false",
            "command_ns": str(status.command_ns),
            "rotation_owed_rad": f"{status.rotation_owed:.2f}",
            "simulated": "" if status.simulated is None else str(status.simulated).lower(),
        },
    )


def to_status(status: DeviceStatus, signature: str) -> DiagnosticStatus:
    """Return the device's status as the message of device/status."""
    return to_diagnostic_status(f"{signature}: device", signature, to_diagnostic(status))
