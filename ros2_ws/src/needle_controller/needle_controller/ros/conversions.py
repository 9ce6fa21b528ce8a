"""plane_controller's messages, to and from plain data."""

from __future__ import annotations

import math

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import (
    PointStamped,
    PoseStamped,
    PoseWithCovarianceStamped,
    Vector3,
    Vector3Stamped,
)
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from needle_common.diagnostics import Diagnostic, Level
from needle_common.errors import UserError
from needle_common.ros.conversions import to_nanoseconds, to_quaternion, to_stamp, values_of
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import angle_axes
from needle_controller.model.point_reach import point_from_message
from needle_controller.model.target_plane import TargetPlane, plane_from_pose
from needle_controller.observers.estimator import Estimate
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.plane_control import ControlUpdate
from needle_controller.protocol.steering import Steering
from needle_controller.protocol.steering_types import (
    DeviceReport,
    SendPath,
    SendStep,
    SteeringState,
)
from needle_controller.protocol.tip_covariance import TipCovariance
from needle_controller.protocol.tip_gate import TipMeasurement

TARGET_PLANE, TARGET_POINT = "target_plane", "target_point"
INSERTION_JOINT, ROTATION_JOINT = "insertion_joint", "rotation_joint"
_LEVELS = {SteeringState.FAULT: Level.ERROR, SteeringState.WAITING_FOR_TIP: Level.WARN}


def to_joint_sample(message: JointState, sent_ns: int) -> JointSample:
    """Return the two joints of a JointState, found by name, with the time of its sending [ns].

    Raises
    ------
    UserError
        If one of them is missing or not finite.
    """
    position = dict(zip(message.name, message.position, strict=False))
    missing = [name for name in (INSERTION_JOINT, ROTATION_JOINT) if name not in position]
    if missing:
        raise UserError(f"joint_states without {' and '.join(missing)}: {list(message.name)}")
    insertion, rotation = position[INSERTION_JOINT], position[ROTATION_JOINT]
    if not (np.isfinite(insertion) and np.isfinite(rotation)):
        raise UserError(f"joint_states are not finite: {insertion} m, {rotation} rad")
    # rclpy gives plain floats where rosbags gives numpy's.
    stamp_ns = to_nanoseconds(message.header.stamp)
    return JointSample(stamp_ns, float(insertion), float(rotation), sent_ns)


def to_tip(message: PointStamped) -> TipMeasurement:
    """Return a measured tip as it came, nothing checked."""
    point = message.point
    return TipMeasurement(
        to_nanoseconds(message.header.stamp),
        message.header.frame_id,
        np.array([point.x, point.y, point.z]),
    )


def to_tip_covariance(message: PoseWithCovarianceStamped) -> TipCovariance:
    """Return the covariance of a measured tip as it came, nothing checked."""
    covariance = np.array(message.pose.covariance).reshape(6, 6)
    stamp_ns = to_nanoseconds(message.header.stamp)
    return TipCovariance(stamp_ns, message.header.frame_id, covariance[:3, :3])


def to_plane(message: PoseStamped) -> TargetPlane:
    """Return the plane a message asks for; raises UserError as `plane_from_pose` does."""
    p, q = message.pose.position, message.pose.orientation
    return plane_from_pose(message.header.frame_id, [p.x, p.y, p.z], [q.x, q.y, q.z, q.w])


def to_target_point(message: PointStamped) -> Array:
    """Return the point a message asks for; raises UserError as `point_from_message` does."""
    p = message.point
    return point_from_message(message.header.frame_id, [p.x, p.y, p.z])


def to_device_status(message: DiagnosticStatus) -> DeviceReport:
    """Return what the protocol needs of device/status."""
    values = values_of(message)
    return DeviceReport(
        state=values.get("state", ""),
        homed=values.get("homed", "").lower() == "true",
        hold_owner=values.get("hold_owner", ""),
        reason=values.get("fault", "") or values.get("reason", "") or message.message,
        insertion=_number(values.get("insertion_m", "")),
        rotation=_number(values.get("rotation_rad", "")),
    )


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def to_trajectory(command: SendStep | SendPath) -> JointTrajectory:
    """Return a step as a trajectory of one point, a path as one of several."""
    message = JointTrajectory(joint_names=[INSERTION_JOINT, ROTATION_JOINT])
    for insertion, rotation, time in command.points:
        point = JointTrajectoryPoint(positions=[insertion, rotation])
        nanoseconds = round(time * 1e9)
        point.time_from_start.sec, point.time_from_start.nanosec = divmod(nanoseconds, 10**9)
        message.points.append(point)
    message.header.stamp = to_stamp(command.stamp_ns)
    return message


def to_header(stamp_ns: int) -> Header:
    """Return a header in the frame of the target plane."""
    return Header(stamp=to_stamp(stamp_ns), frame_id=TARGET_PLANE)


def to_pose(estimate: Estimate, stamp_ns: int) -> PoseWithCovarianceStamped:
    """Return the estimated pose, its covariance in the message's fixed-axis convention."""
    message = PoseWithCovarianceStamped(header=to_header(stamp_ns))
    pose = message.pose.pose
    pose.position.x, pose.position.y, pose.position.z = (float(c) for c in estimate.position)
    pose.orientation = to_quaternion(estimate.rotation.tolist())
    turn = np.eye(6)
    turn[3:, 3:] = angle_axes(estimate.coordinates[3:])
    message.pose.covariance = (turn @ estimate.covariance @ turn.T).ravel()
    return message


def to_vector(values: Array, stamp_ns: int) -> Vector3Stamped:
    """Return three numbers stamped in the frame of the target plane."""
    x, y, z = (float(value) for value in values)
    return Vector3Stamped(header=to_header(stamp_ns), vector=Vector3(x=x, y=y, z=z))


def to_control_input(update: ControlUpdate, stamp_ns: int) -> Vector3Stamped:
    """Return (v, u, rotation of the base since the first tip)."""
    command = update.command
    values = np.array([command.virtual_input, command.rotation_rate, update.turned])
    return to_vector(values, stamp_ns)


def to_diagnostic(steering: Steering, preset: str) -> Diagnostic:
    """Return needle/controller_status as a line of health."""
    reachable, reachable_depth = "", ""
    if steering.reach is not None:
        reachable = str(bool(steering.reach.reachable)).lower()
        reachable_depth = repr(float(steering.reach.depth))
    point = steering.control.target_point
    values = {
        "state": steering.state.value,
        "starts": str(steering.starts),
        "step": str(steering.step),
        "insertion_m": repr(steering.insertion),
        "target_offset_m": repr(steering.control.plane.offset),
        "target_point_m": "" if point is None else ", ".join(repr(float(c)) for c in point),
        "obstacles": str(len(steering.control.obstacles)),
        "reachable": reachable,
        "reachable_depth_m": reachable_depth,
        "trusted": steering.trust.verdict,
        "r1_low_m": _said(steering.trust.low),
        "r1_high_m": _said(steering.trust.high),
        "reason": steering.patience.silence or steering.reason,
        "awaiting": steering.awaiting.value,
        "insertion": steering.settings.insertion,
        "command_ns": str(steering.command_ns),
        "tip_after_ns": str(steering.intake.after_ns),
        "tips_rejected": str(steering.intake.refused.total()),
        "tips_rejected_for": ", ".join(
            f"{fault.value} {count}" for fault, count in steering.intake.refused.items()
        ),
        "watchdog_trips": str(steering.watchdog_trips),
        "preset": preset,
        "depth_m": repr(steering.settings.depth),
    }
    level = _LEVELS.get(steering.state, Level.OK)
    if steering.rejection or steering.patience.silence or steering.trust.is_doubtful:
        level = max(level, Level.WARN)
    return Diagnostic(level, values["reason"] or steering.state.value, values)


def _said(value: float) -> str:
    """Return a number's text, empty for none."""
    return repr(value) if math.isfinite(value) else ""
