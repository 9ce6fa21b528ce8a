"""Table between the messages of `messages` and their ROS types.

It works on rclpy's classes and on rosbags' alike, which have the same fields: so CDR is written and
read with and without ROS.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from needle_core import messages as m
from needle_core.diagnostics import Level
from needle_core.message_types import NANOSECONDS, MessageTypes
from needle_core.status_messages import ControllerStatus, DeviceStatus, KeyValues

_STATUS = "diagnostic_msgs/msg/DiagnosticStatus"
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)
_LOG_LEVELS = {"debug": 10, "info": 20, "warning": 30, "error": 40, "fatal": 50}


@dataclass(frozen=True)
class Row:
    """A message's ROS type, the fields of its ROS message, and the way back."""

    ros_type: str
    to_fields: Callable[[Any, MessageTypes], dict[str, Any]]
    from_ros: Callable[[Any], Any]


class Converter:
    """The table on one family of message classes.

    Parameters
    ----------
    types : MessageTypes
        The family.
    """

    def __init__(self, types: MessageTypes) -> None:
        self._types = types

    def to_ros(self, message: Any) -> Any:
        """Return a message as its ROS message."""
        row = TABLE[type(message)]
        return self._types.make(row.ros_type)(**row.to_fields(message, self._types))


def ros_type(kind: type[Any]) -> str:
    """Return the name of the ROS type of a kind of message."""
    return TABLE[kind].ros_type


def from_ros(kind: type[Any], message: Any) -> Any:
    """Return a ROS message of either family as a `kind` of message.

    Nothing is checked but its form: that is the receiver's business.
    """
    return TABLE[kind].from_ros(message)


def to_nanoseconds(stamp: Any) -> int:
    """Return a builtin_interfaces/Time in nanoseconds."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def _floats(values: Any) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _xyz(v: Any) -> m.Vector3:
    return (float(v.x), float(v.y), float(v.z))


def _xyzw(q: Any) -> m.Quaternion:
    return (float(q.x), float(q.y), float(q.z), float(q.w))


def _joint_state_fields(message: m.JointState, t: MessageTypes) -> dict[str, Any]:
    return {
        "header": t.header(message.stamp_ns),
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
            _floats(point.positions),
            int(point.time_from_start.sec) + int(point.time_from_start.nanosec) * 1e-9,
            _floats((*point.velocities, *point.accelerations, *point.effort)),
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
    return m.Joystick(to_nanoseconds(message.header.stamp), _floats(message.axes), buttons)


def _hold_fields(message: m.HoldState, t: MessageTypes) -> dict[str, Any]:
    axes = (message.speed_scale, *filter(math.isfinite, (message.lifetime,)))
    joystick = m.Joystick(message.stamp_ns, axes, (int(message.pressed),))
    return _joystick_fields(joystick, t, message.source)


def _hold(message: Any) -> m.HoldState:
    """Return the hold of a Joy; one without a button or an axis is a release."""
    axes, buttons = message.axes, message.buttons
    return m.HoldState(
        to_nanoseconds(message.header.stamp),
        message.header.frame_id,
        len(buttons) > 0 and int(buttons[0]) == 1,
        float(axes[0]) if len(axes) > 0 else math.nan,
        float(axes[1]) if len(axes) > 1 else math.inf,
    )


def _covariance_fields(message: m.PoseWithCovariance, t: MessageTypes) -> dict[str, Any]:
    pose = t.make("geometry_msgs/msg/PoseWithCovariance")(
        pose=t.pose(message.position, message.orientation),
        covariance=t.array(np.float64, message.covariance),
    )
    return {"header": t.header(message.stamp_ns, message.frame_id), "pose": pose}


def _path_fields(message: m.Path, t: MessageTypes) -> dict[str, Any]:
    header, make = t.header(message.stamp_ns, message.frame_id), t.make(ros_type(m.Pose))
    poses = [make(header=header, pose=t.pose(at, _UPRIGHT)) for at in message.positions]
    return {"header": header, "poses": poses}


def _ros_transform(message: m.Transform, t: MessageTypes) -> Any:
    return t.make("geometry_msgs/msg/TransformStamped")(
        header=t.header(message.stamp_ns, message.frame_id),
        child_frame_id=message.child_frame_id,
        transform=t.make("geometry_msgs/msg/Transform")(
            translation=t.vector(message.translation), rotation=t.quaternion(message.rotation)
        ),
    )


def _transform(message: Any) -> m.Transform:
    return m.Transform(
        to_nanoseconds(message.header.stamp),
        message.header.frame_id,
        message.child_frame_id,
        _xyz(message.transform.translation),
        _xyzw(message.transform.rotation),
    )


def _image_fields(message: m.Image, t: MessageTypes) -> dict[str, Any]:
    return {
        "header": t.header(message.stamp_ns, message.frame_id),
        "height": message.height,
        "width": message.width,
        "encoding": message.encoding,
        "is_bigendian": 0,
        "step": message.step,
        "data": t.octets(message.data),
    }


def _image(message: Any) -> m.Image:
    return m.Image(
        to_nanoseconds(message.header.stamp),
        message.header.frame_id,
        int(message.height),
        int(message.width),
        message.encoding,
        int(message.step),
        # Not copied: images are large, and come 60 a second.
        memoryview(message.data),
    )


def _camera_info_fields(message: m.CameraInfo, t: MessageTypes) -> dict[str, Any]:
    roi = message.roi
    return {
        "header": t.header(message.stamp_ns, message.frame_id),
        "height": message.height,
        "width": message.width,
        "distortion_model": message.distortion_model,
        **{name: t.array(np.float64, getattr(message, name)) for name in "dkrp"},
        "binning_x": message.binning_x,
        "binning_y": message.binning_y,
        "roi": t.make("sensor_msgs/msg/RegionOfInterest")(
            x_offset=roi.x_offset,
            y_offset=roi.y_offset,
            height=roi.height,
            width=roi.width,
            do_rectify=False,
        ),
    }


def _camera_info(message: Any) -> m.CameraInfo:
    roi = message.roi
    return m.CameraInfo(
        to_nanoseconds(message.header.stamp),
        message.header.frame_id,
        int(message.height),
        int(message.width),
        message.distortion_model,
        _floats(message.d),
        _floats(message.k),
        _floats(message.r),
        _floats(message.p),
        int(message.binning_x),
        int(message.binning_y),
        m.RegionOfInterest(*(int(v) for v in (roi.x_offset, roi.y_offset, roi.width, roi.height))),
    )


def _marker(message: Any) -> m.Marker:
    colour = message.color
    return m.Marker(
        message.header.frame_id,
        message.ns,
        int(message.id),
        int(message.type),
        int(message.action),
        _xyz(message.pose.position),
        _xyzw(message.pose.orientation),
        _xyz(message.scale),
        to_nanoseconds(message.header.stamp),
        (float(colour.r), float(colour.g), float(colour.b), float(colour.a)),
        tuple(map(_xyz, message.points)),
    )


def _ros_marker(marker: m.Marker, t: MessageTypes) -> Any:
    red, green, blue, opacity = marker.colour
    color = t.make("std_msgs/msg/ColorRGBA")(r=red, g=green, b=blue, a=opacity)
    image = t.make("sensor_msgs/msg/CompressedImage")
    return t.make("visualization_msgs/msg/Marker")(
        header=t.header(marker.stamp_ns, marker.frame_id),
        ns=marker.namespace,
        id=marker.number,
        type=marker.kind,
        action=marker.action,
        pose=t.pose(marker.position, marker.orientation),
        scale=t.vector(marker.scale),
        color=color,
        lifetime=t.duration(0.0),
        frame_locked=False,
        points=[t.point(at) for at in marker.points],
        colors=[],
        texture_resource="",
        texture=image(header=t.header(0), format="", data=t.array(np.uint8, ())),
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=t.make("visualization_msgs/msg/MeshFile")(
            filename="", data=t.array(np.uint8, ())
        ),
        mesh_use_embedded_materials=False,
    )


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
            to_nanoseconds(r.header.stamp), tuple(r.name), _floats(r.position), _floats(r.velocity)
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
        lambda message, t: {
            "header": t.header(message.stamp_ns, message.frame_id),
            "point": t.point(message.position),
        },
        lambda r: m.Point(to_nanoseconds(r.header.stamp), r.header.frame_id, _xyz(r.point)),
    ),
    m.Vector: Row(
        "geometry_msgs/msg/Vector3Stamped",
        lambda message, t: {
            "header": t.header(message.stamp_ns, message.frame_id),
            "vector": t.vector(message.values),
        },
        lambda r: m.Vector(to_nanoseconds(r.header.stamp), r.header.frame_id, _xyz(r.vector)),
    ),
    m.Pose: Row(
        "geometry_msgs/msg/PoseStamped",
        lambda message, t: {
            "header": t.header(message.stamp_ns, message.frame_id),
            "pose": t.pose(message.position, message.orientation),
        },
        lambda r: m.Pose(
            to_nanoseconds(r.header.stamp),
            r.header.frame_id,
            _xyz(r.pose.position),
            _xyzw(r.pose.orientation),
        ),
    ),
    m.PoseWithCovariance: Row(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        _covariance_fields,
        lambda r: m.PoseWithCovariance(
            to_nanoseconds(r.header.stamp),
            r.header.frame_id,
            _xyz(r.pose.pose.position),
            _xyzw(r.pose.pose.orientation),
            _floats(r.pose.covariance),
        ),
    ),
    m.Path: Row(
        "nav_msgs/msg/Path",
        _path_fields,
        lambda r: m.Path(
            to_nanoseconds(r.header.stamp),
            r.header.frame_id,
            tuple(_xyz(pose.pose.position) for pose in r.poses),
        ),
    ),
    m.Transforms: Row(
        "tf2_msgs/msg/TFMessage",
        lambda message, t: {"transforms": [_ros_transform(one, t) for one in message.transforms]},
        lambda r: m.Transforms(tuple(map(_transform, r.transforms))),
    ),
    m.Image: Row("sensor_msgs/msg/Image", _image_fields, _image),
    m.CompressedImage: Row(
        "sensor_msgs/msg/CompressedImage",
        lambda message, t: {
            "header": t.header(message.stamp_ns, message.frame_id),
            "format": message.format,
            "data": t.octets(message.data),
        },
        lambda r: m.CompressedImage(
            to_nanoseconds(r.header.stamp), r.header.frame_id, r.format, bytes(r.data)
        ),
    ),
    m.CameraInfo: Row("sensor_msgs/msg/CameraInfo", _camera_info_fields, _camera_info),
    m.Text: Row(
        "std_msgs/msg/String",
        lambda message, t: {"data": message.text},
        lambda r: m.Text(r.data),
    ),
    m.Markers: Row(
        "visualization_msgs/msg/MarkerArray",
        lambda message, t: {"markers": [_ros_marker(marker, t) for marker in message.markers]},
        lambda r: m.Markers(tuple(_marker(marker) for marker in r.markers)),
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
    m.LogLine: Row("rcl_interfaces/msg/Log", _log_fields, _log),
}
"""Kind of message to its row."""
