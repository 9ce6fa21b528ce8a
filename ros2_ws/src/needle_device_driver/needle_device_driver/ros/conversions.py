"""The device's messages, to and from plain data."""

from __future__ import annotations

import math

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import JointState, Joy
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory

from needle_core.ros.conversions import to_diagnostic_status, to_nanoseconds, to_stamp
from needle_device_driver.axes.axis_pair import PairSnapshot
from needle_device_driver.device import device_status
from needle_device_driver.supervisor.command import (
    INSERTION_JOINT,
    ROTATION_JOINT,
    Command,
    CommandPoint,
)
from needle_device_driver.supervisor.hold import HoldMessage
from needle_device_driver.supervisor.reports import DeviceStatus, StepResult


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


def to_status(status: DeviceStatus, signature: str) -> DiagnosticStatus:
    """Return the device's status as the message of device/status."""
    return to_diagnostic_status(
        f"{signature}: device", signature, device_status(status, signature).diagnostic
    )
