"""Conversion between the messages of `messages` and their ROS types.

It works on the classes of rclpy and of rosbags, which have the same fields, so that CDR can be
written and read with and without ROS.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from needle_core import messages as m
from needle_core.diagnostics import Level
from needle_core.message_types import MessageTypes, Row, floats, head, to_nanoseconds, xyz, xyzw
from needle_core.status_messages import ControllerStatus, DeviceStatus, KeyValues
from needle_core.view_rows import VIEW_ROWS

_STATUS = "diagnostic_msgs/msg/DiagnosticStatus"
_LOG_LEVELS = {"debug": 10, "info": 20, "warning": 30, "error": 40, "fatal": 50}


class Converter:
    """Converts messages to one family of ROS classes.

    Parameters
    ----------
    types : MessageTypes
        Family of classes.
    """

    def __init__(self, types: MessageTypes) -> None:
        self._types = types

    def to_ros(self, message: Any) -> Any:
        """Return a message as a ROS message."""
        row = TABLE[type(message)]
        return self._types.make(row.ros_type)(**row.to_fields(message, self._types))


def ros_type(kind: type[Any]) -> str:
    """Return the name of the ROS type of a message class."""
    return TABLE[kind].ros_type


def from_ros(kind: type[Any], message: Any) -> Any:
    """Return a ROS message of either family as a message of class `kind`.

    Only the structure is checked; the receiver checks the values.
    """
    return TABLE[kind].from_ros(message)


def _joint_state_fields(message: m.JointState, t: MessageTypes) -> dict[str, Any]:
    return {
        "header": t.header_of(message),
        "name": list(message.names),
        "position": t.array(np.float64, message.positions),
        "velocity": t.array(np.float64, message.velocities),
        "effort": t.array(np.float64, ()),
    }


def _trajectory_fields(message: m.Trajectory, t: MessageTypes) -> dict[str, Any]:
    make, none = t.make("trajectory_msgs/msg/JointTrajectoryPoint"), ()
    points = [
        make(
            positions=t.array(np.float64, point.positions),
            velocities=t.array(np.float64, point.others),
            accelerations=t.array(np.float64, none),
            effort=t.array(np.float64, none),
            time_from_start=t.duration(point.time_from_start),
        )
        for point in message.points
    ]
    names = list(message.joint_names)
    return {"header": t.header(message.stamp_ns), "joint_names": names, "points": points}


def _trajectory(message: Any) -> m.Trajectory:
    points = [
        m.TrajectoryPoint(
            floats(point.positions),
            int(point.time_from_start.sec) + int(point.time_from_start.nanosec) * 1e-9,
            floats((*point.velocities, *point.accelerations, *point.effort)),
        )
        for point in message.points
    ]
    names = tuple(message.joint_names)
    return m.Trajectory(to_nanoseconds(message.header.stamp), names, tuple(points))


def _joystick_fields(message: m.Joystick, t: MessageTypes, frame_id: str = "") -> dict[str, Any]:
    return {
        "header": t.header(message.stamp_ns, frame_id),
        "axes": t.array(np.float32, message.axes),
        "buttons": t.array(np.int32, message.buttons),
    }


def _joystick(message: Any) -> m.Joystick:
    buttons = tuple(int(button) for button in message.buttons)
    return m.Joystick(to_nanoseconds(message.header.stamp), floats(message.axes), buttons)


def _hold_fields(message: m.HoldState, t: MessageTypes) -> dict[str, Any]:
    axes = (message.speed_scale, *filter(math.isfinite, (message.lifetime,)))
    joystick = m.Joystick(message.count, axes, (int(message.pressed),))
    return _joystick_fields(joystick, t, message.sender)


def _hold(message: Any) -> m.HoldState:
    """Return the hold state in a Joy message; without a button or an axis it is a release."""
    axes, buttons = message.axes, message.buttons
    return m.HoldState(
        *m.HoldState.split_sender(message.header.frame_id),
        to_nanoseconds(message.header.stamp),
        len(buttons) > 0 and int(buttons[0]) == 1,
        float(axes[0]) if len(axes) > 0 else math.nan,
        float(axes[1]) if len(axes) > 1 else math.inf,
    )


def _covariance_fields(message: m.PoseWithCovariance, t: MessageTypes) -> dict[str, Any]:
    pose = t.make("geometry_msgs/msg/PoseWithCovariance")(
        pose=t.pose(message.position, message.orientation),
        covariance=t.array(np.float64, message.covariance),
    )
    return {"header": t.header_of(message), "pose": pose}


def _status_fields(message: m.Status, t: MessageTypes) -> dict[str, Any]:
    make = t.make("diagnostic_msgs/msg/KeyValue")
    return {
        "level": t.byte(int(message.level)),
        "name": f"{message.source}: {message.part}",
        "message": message.text,
        "hardware_id": message.source,
        "values": [make(key=key, value=value) for key, value in message.values.items()],
    }


def _status(message: Any) -> m.Status:
    level = message.level
    return m.Status(
        message.hardware_id,
        message.name.rpartition(": ")[2],
        Level(level[0] if isinstance(level, bytes) else int(level)),
        message.message,
        {pair.key: pair.value for pair in message.values},
    )


def _key_values(kind: type[KeyValues]) -> Row:
    return Row(
        _STATUS, lambda message, t: _status_fields(message.status, t), lambda r: kind.of(_status(r))
    )


def _diagnostics_fields(message: m.Diagnostics, t: MessageTypes) -> dict[str, Any]:
    make = t.make(_STATUS)
    statuses = [make(**_status_fields(status, t)) for status in message.statuses]
    return {"header": t.header(message.stamp_ns), "status": statuses}


def _log_fields(message: m.LogLine, t: MessageTypes) -> dict[str, Any]:
    return {
        "stamp": t.time(message.stamp_ns),
        "level": _LOG_LEVELS[message.severity],
        "name": message.source.lstrip("/"),
        "msg": message.text,
        "file": "",
        "function": "",
        "line": 0,
    }


def _log(r: Any) -> m.LogLine:
    severity = {level: name for name, level in _LOG_LEVELS.items()}[int(r.level)]
    return m.LogLine(to_nanoseconds(r.stamp), severity, r.name, r.msg)


TABLE: dict[type[Any], Row] = {
    m.JointState: Row(
        "sensor_msgs/msg/JointState",
        _joint_state_fields,
        lambda r: m.JointState(
            to_nanoseconds(r.header.stamp),
            tuple(r.name),
            floats(r.position),
            floats(r.velocity),
            r.header.frame_id,
        ),
    ),
    m.Trajectory: Row("trajectory_msgs/msg/JointTrajectory", _trajectory_fields, _trajectory),
    m.CommandResult: Row(
        "std_msgs/msg/Header",
        lambda message, t: {"stamp": t.time(message.stamp_ns), "frame_id": message.outcome},
        lambda r: m.CommandResult(to_nanoseconds(r.stamp), r.frame_id),
    ),
    m.HoldState: Row("sensor_msgs/msg/Joy", _hold_fields, _hold),
    m.Joystick: Row("sensor_msgs/msg/Joy", _joystick_fields, _joystick),
    m.EmergencyStop: Row(
        "std_msgs/msg/Bool",
        lambda message, t: {"data": message.pressed},
        lambda r: m.EmergencyStop(bool(r.data)),
    ),
    m.Point: Row(
        "geometry_msgs/msg/PointStamped",
        lambda message, t: {"header": t.header_of(message), "point": t.point(message.position)},
        lambda r: m.Point(*head(r), xyz(r.point)),
    ),
    m.BarePoint: Row(
        "geometry_msgs/msg/Point",
        lambda message, t: dict(zip("xyz", message.position, strict=True)),
        lambda r: m.BarePoint(xyz(r)),
    ),
    m.Vector: Row(
        "geometry_msgs/msg/Vector3Stamped",
        lambda message, t: {"header": t.header_of(message), "vector": t.vector(message.values)},
        lambda r: m.Vector(*head(r), xyz(r.vector)),
    ),
    m.Pose: Row(
        "geometry_msgs/msg/PoseStamped",
        lambda message, t: {
            "header": t.header_of(message),
            "pose": t.pose(message.position, message.orientation),
        },
        lambda r: m.Pose(*head(r), xyz(r.pose.position), xyzw(r.pose.orientation)),
    ),
    m.PoseWithCovariance: Row(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        _covariance_fields,
        lambda r: m.PoseWithCovariance(
            *head(r),
            xyz(r.pose.pose.position),
            xyzw(r.pose.pose.orientation),
            floats(r.pose.covariance),
        ),
    ),
    m.Text: Row(
        "std_msgs/msg/String",
        lambda message, t: {"data": message.text},
        lambda r: m.Text(r.data),
    ),
    m.Status: Row(_STATUS, _status_fields, _status),
    DeviceStatus: _key_values(DeviceStatus),
    ControllerStatus: _key_values(ControllerStatus),
    m.Diagnostics: Row(
        "diagnostic_msgs/msg/DiagnosticArray",
        _diagnostics_fields,
        lambda r: m.Diagnostics(
            to_nanoseconds(r.header.stamp), tuple(_status(status) for status in r.status)
        ),
    ),
    **VIEW_ROWS,
    m.LogLine: Row("rcl_interfaces/msg/Log", _log_fields, _log),
}
"""Message class to its row."""
