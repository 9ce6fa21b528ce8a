"""Conversion between the messages of `messages` and their ROS types.

It works on the classes of rclpy and of rosbags, which have the same fields, so that CDR can be
written and read with and without ROS.
"""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

from needle_core import messages as m
from needle_core.diagnostics import Level
from needle_core.message_shapes import (
    BOOL,
    COLOUR,
    DOUBLES,
    DURATION,
    FLOATS,
    HEADER,
    INT,
    INTS,
    ONLY_STAMP,
    PIXELS,
    POINT,
    POSE,
    QUATERNION,
    STAMP,
    TEXT,
    TEXTS,
    VECTOR,
    Codec,
    Row,
    Shape,
    each,
)
from needle_core.message_types import MessageTypes, to_nanoseconds
from needle_core.status_messages import ControllerStatus, DeviceStatus, KeyValues


def to_ros(message: Any, types: MessageTypes) -> Any:
    """Return a message as a ROS message of a family of classes."""
    return TABLE[type(message)].to_ros(message, types)


def ros_type(kind: type[Any]) -> str:
    """Return the name of the ROS type of a message class."""
    return TABLE[kind].ros_type


def from_ros(kind: type[Any], message: Any) -> Any:
    """Return a ROS message of either family as a message of class `kind`.

    Only the structure is checked; the receiver checks the values.
    """
    return TABLE[kind].from_ros(message)


# ---- messages whose attributes are not fields -------------------------------------------------

_POINT = Shape(
    "trajectory_msgs/msg/JointTrajectoryPoint",
    positions=DOUBLES,
    velocities=DOUBLES.of("others"),
    time_from_start=DURATION,
)


def _trajectory_point(r: Any) -> m.TrajectoryPoint:
    others = DOUBLES.from_ros((*r.velocities, *r.accelerations, *r.effort))
    return m.TrajectoryPoint(**{**_POINT.values(r), "others": others})


_JOY = {"axes": FLOATS, "buttons": INTS}
_HOLD = Shape("sensor_msgs/msg/Joy", header=HEADER, **_JOY)


def _hold_to_ros(message: m.HoldState, t: MessageTypes) -> Any:
    axes = (message.speed_scale, *filter(math.isfinite, (message.lifetime,)))
    buttons = (int(message.pressed),)
    joy = SimpleNamespace(
        stamp_ns=message.count, frame_id=message.sender, axes=axes, buttons=buttons
    )
    return _HOLD.to_ros(joy, t)


def _hold(r: Any) -> m.HoldState:
    """Return the hold state in a Joy message; without a button or an axis it is a release."""
    axes, buttons = r.axes, r.buttons
    return m.HoldState(
        *m.HoldState.split_sender(r.header.frame_id),
        to_nanoseconds(r.header.stamp),
        len(buttons) > 0 and int(buttons[0]) == 1,
        float(axes[0]) if len(axes) > 0 else math.nan,
        float(axes[1]) if len(axes) > 1 else math.inf,
    )


def _pairs_to_ros(values: dict[str, str], t: MessageTypes) -> list[Any]:
    make = t.make("diagnostic_msgs/msg/KeyValue")
    return [make(key=key, value=value) for key, value in values.items()]


_STATUS = Shape(
    "diagnostic_msgs/msg/DiagnosticStatus",
    level=Codec(
        lambda level, t: t.byte(int(level)),
        lambda r: Level(r[0] if isinstance(r, bytes) else int(r)),
    ),
    name=TEXT,
    message=TEXT.of("text"),
    hardware_id=TEXT.of("source"),
    values=Codec(_pairs_to_ros, lambda r: {pair.key: pair.value for pair in r}),
)


def _status(r: Any) -> m.Status:
    values = _STATUS.values(r)
    return m.Status(part=values.pop("name").rpartition(": ")[2], **values)


def _key_values(kind: type[KeyValues]) -> Row:
    return Row(
        _STATUS.ros_type,
        lambda message, t: _STATUS.to_ros(message.status, t),
        lambda r: kind.of(_status(r)),
    )


def _path_to_ros(path: m.Path, t: MessageTypes) -> Any:
    header, upright = HEADER.to_ros(path, t), (0.0, 0.0, 0.0, 1.0)
    make = t.make("geometry_msgs/msg/PoseStamped")
    poses = [make(header=header, pose=_pair_to_ros((at, upright), t)) for at in path.positions]
    return t.make("nav_msgs/msg/Path")(header=header, poses=poses)


def _path(r: Any) -> m.Path:
    positions = (POINT.from_ros(pose.pose.position) for pose in r.poses)
    return m.Path(positions=tuple(positions), **HEADER.values(r.header))


def _pair_to_ros(pair: tuple[m.Vector3, m.Quaternion], t: MessageTypes) -> Any:
    return POSE.to_ros(SimpleNamespace(position=pair[0], orientation=pair[1]), t)


_PAIR = Codec(
    _pair_to_ros, lambda r: (POINT.from_ros(r.position), QUATERNION.from_ros(r.orientation))
)


# ---- the table --------------------------------------------------------------------------------

_STATUS_ROW = Row(_STATUS.ros_type, _STATUS.to_ros, _status)
_POINT_ROW = Row(_POINT.ros_type, _POINT.to_ros, _trajectory_point)
_TRANSFORM_ROW = Shape(
    "geometry_msgs/msg/TransformStamped",
    header=HEADER,
    child_frame_id=TEXT,
    transform=Shape("geometry_msgs/msg/Transform", translation=VECTOR, rotation=QUATERNION),
).row(m.Transform)
_REGION_ROW = Shape(
    "sensor_msgs/msg/RegionOfInterest",
    x_offset=INT,
    y_offset=INT,
    height=INT,
    width=INT,
).row(m.RegionOfInterest)
_MARKER_ROW = Shape(
    "visualization_msgs/msg/Marker",
    header=HEADER,
    ns=TEXT.of("namespace"),
    id=INT.of("number"),
    type=INT.of("kind"),
    action=INT,
    pose=POSE,
    scale=VECTOR,
    color=COLOUR.of("colour"),
    points=each(POINT),
).row(m.Marker)
_LEVELS = {"debug": 10, "info": 20, "warning": 30, "error": 40, "fatal": 50}
_SEVERITIES = {level: name for name, level in _LEVELS.items()}

_SHAPES = {
    m.JointState: Shape(
        "sensor_msgs/msg/JointState",
        header=HEADER,
        name=TEXTS.of("names"),
        position=DOUBLES.of("positions"),
        velocity=DOUBLES.of("velocities"),
    ),
    m.Trajectory: Shape(
        "trajectory_msgs/msg/JointTrajectory",
        header=ONLY_STAMP,
        joint_names=TEXTS,
        points=each(_POINT_ROW),
    ),
    m.CommandResult: Shape(
        "std_msgs/msg/Header", stamp=STAMP.of("stamp_ns"), frame_id=TEXT.of("outcome")
    ),
    m.Joystick: Shape("sensor_msgs/msg/Joy", header=ONLY_STAMP, **_JOY),
    m.EmergencyStop: Shape("std_msgs/msg/Bool", data=BOOL.of("pressed")),
    m.Point: Shape("geometry_msgs/msg/PointStamped", header=HEADER, point=POINT.of("position")),
    m.Vector: Shape("geometry_msgs/msg/Vector3Stamped", header=HEADER, vector=VECTOR.of("values")),
    m.Pose: Shape("geometry_msgs/msg/PoseStamped", header=HEADER, pose=POSE),
    m.PoseWithCovariance: Shape(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        header=HEADER,
        pose=Shape("geometry_msgs/msg/PoseWithCovariance", pose=POSE, covariance=DOUBLES),
    ),
    m.Text: Shape("std_msgs/msg/String", data=TEXT.of("text")),
    m.Diagnostics: Shape(
        "diagnostic_msgs/msg/DiagnosticArray",
        header=ONLY_STAMP,
        status=each(_STATUS_ROW).of("statuses"),
    ),
    m.Poses: Shape("geometry_msgs/msg/PoseArray", header=HEADER, poses=each(_PAIR)),
    m.Transforms: Shape("tf2_msgs/msg/TFMessage", transforms=each(_TRANSFORM_ROW)),
    m.Image: Shape(
        "sensor_msgs/msg/Image",
        header=HEADER,
        height=INT,
        width=INT,
        encoding=TEXT,
        step=INT,
        data=PIXELS,
    ),
    m.CompressedImage: Shape(
        "sensor_msgs/msg/CompressedImage",
        header=HEADER,
        format=TEXT,
        data=PIXELS._replace(from_ros=bytes),
    ),
    m.CameraInfo: Shape(
        "sensor_msgs/msg/CameraInfo",
        header=HEADER,
        height=INT,
        width=INT,
        distortion_model=TEXT,
        **dict.fromkeys("dkrp", DOUBLES),
        binning_x=INT,
        binning_y=INT,
        roi=Codec(_REGION_ROW.to_ros, _REGION_ROW.from_ros),
    ),
    m.Markers: Shape("visualization_msgs/msg/MarkerArray", markers=each(_MARKER_ROW)),
    m.LogLine: Shape(
        "rcl_interfaces/msg/Log",
        stamp=STAMP.of("stamp_ns"),
        level=Codec(lambda name, t: _LEVELS[name], lambda r: _SEVERITIES[int(r)]).of("severity"),
        name=Codec(lambda name, t: name.lstrip("/"), str).of("source"),
        msg=TEXT.of("text"),
    ),
}

TABLE: dict[type[Any], Row] = {
    **{kind: shape.row(kind) for kind, shape in _SHAPES.items()},
    m.HoldState: Row(_HOLD.ros_type, _hold_to_ros, _hold),
    m.BarePoint: Row(
        "geometry_msgs/msg/Point",
        lambda message, t: POINT.to_ros(message.position, t),
        lambda r: m.BarePoint(POINT.from_ros(r)),
    ),
    m.Status: _STATUS_ROW,
    DeviceStatus: _key_values(DeviceStatus),
    ControllerStatus: _key_values(ControllerStatus),
    m.Path: Row("nav_msgs/msg/Path", _path_to_ros, _path),
    m.Transform: _TRANSFORM_ROW,
}
"""Message class to its row."""
