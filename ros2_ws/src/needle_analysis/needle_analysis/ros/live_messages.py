"""A needle's drawing as standard messages in `rig`."""

from __future__ import annotations

import array
from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Transform, TransformStamped
from nav_msgs.msg import Path
from numpy.typing import NDArray
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from needle_analysis.live.live_needle import LiveNeedle, SeenTip
from needle_analysis.live.spread import ellipsoid
from needle_controller.model.target_plane import RIG
from needle_core.ros.conversions import to_quaternion, to_stamp

Array = NDArray[np.float64]

TARGET_FRAME, TIP_FRAME = "target_plane", "needle_tip"
# What is drawn is as thick and long as it must be to be seen [m].
_SHAFT, _TIP, _POINT = 1e-3, 2.5e-3, 4e-3
_ARROW = (2e-2, 8e-4, 8e-4)
_PLANE = (2e-4, 8e-2, 2e-1)
_PLANE_CENTRE = 1e-1
# Blue, orange, yellow and grey differ also to who sees no red or green.
_BLUE, _ORANGE, _YELLOW, _GREY = (0.2, 0.6, 1.0), (1.0, 0.6, 0.1), (1.0, 0.9, 0.2), (0.7, 0.7, 0.7)


def to_tip(tip: SeenTip) -> PoseStamped:
    """Return the measured tip, its z axis along the shaft."""
    return PoseStamped(header=_header(to_stamp(tip.stamp_ns)), pose=_tip_pose(tip))


def to_path(path: Array, stamp: Time) -> Path:
    """Return the way of the tip, shape (n, 3) [m]."""
    header = _header(stamp)
    poses = [PoseStamped(header=header, pose=_pose(place)) for place in path]
    return Path(header=header, poses=poses)


def to_markers(needle: LiveNeedle, stamp: Time) -> MarkerArray:
    """Return shaft, tip, estimate, its 95 % ellipsoid, plane and target point.

    What is not known is taken away, so that nothing old stays in view.
    """
    shaft, belief, plane, point = needle.shaft, needle.belief, needle.plane, needle.target_point
    tip = needle.tip
    place, covariance = None, None
    if belief is not None:
        place, covariance = belief.place, belief.covariance
    elif tip is not None:
        place, covariance = tip.place, tip.covariance
    drawn: list[Marker] = []

    def draw(name: str, kind: int) -> Marker:
        marker = Marker(header=_header(stamp), ns=name, type=kind, action=Marker.ADD)
        drawn.append(marker)
        return marker

    if shaft is not None:
        marker = draw("shaft", Marker.LINE_STRIP)
        marker.points = [_point(at) for at in shaft]
        marker.pose.orientation.w = 1.0
        _look(marker, (_SHAFT, 0.0, 0.0), _BLUE)
        marker = draw("tip", Marker.SPHERE)
        marker.pose = _pose(shaft[-1])
        _look(marker, (_TIP,) * 3, _BLUE if needle.is_seen else _GREY)
    if belief is not None:
        marker = draw("estimate", Marker.ARROW)
        heading = belief.rotation[:, 2]
        marker.points = [_point(belief.place), _point(belief.place + _ARROW[0] * heading)]
        marker.pose.orientation.w = 1.0
        _look(marker, (_ARROW[1], 2.0 * _ARROW[2], 0.0), _ORANGE)
    if place is not None and covariance is not None:
        axes, lengths = ellipsoid(covariance)
        marker = draw("uncertainty", Marker.SPHERE)
        marker.pose = _pose(place, to_quaternion(axes.tolist()))
        _look(marker, [2.0 * float(length) for length in lengths], _ORANGE, 0.35)
    if plane is not None:
        marker = draw("plane", Marker.CUBE)
        rotation = plane.T_rig_plane[:3, :3]
        centre = plane.T_rig_plane[:3, 3] + _PLANE_CENTRE * rotation[:, 2]
        marker.pose = _pose(centre, to_quaternion(rotation.tolist()))
        _look(marker, _PLANE, _YELLOW, 0.25)
    if point is not None:
        marker = draw("target_point", Marker.SPHERE)
        marker.pose = _pose(point)
        _look(marker, (_POINT,) * 3, _YELLOW)
    shown = {marker.ns for marker in drawn}
    gone = [
        Marker(header=_header(stamp), ns=name, action=Marker.DELETE)
        for name in ("shaft", "tip", "estimate", "uncertainty", "plane", "target_point")
        if name not in shown
    ]
    return MarkerArray(markers=[*drawn, *gone])


def to_image(data: bytes, side: str, stamp_ns: int) -> CompressedImage:
    """Return a JPEG file of a camera's view."""
    header = Header(stamp=to_stamp(stamp_ns), frame_id=camera_frame(side))
    return CompressedImage(header=header, format="jpeg", data=array.array("B", data))


def to_transforms(needle: LiveNeedle, stamp: Time) -> list[TransformStamped]:
    """Return where the wanted plane and the measured tip are in `rig`."""
    found = []
    if needle.plane is not None:
        found.append(_transform(needle.plane.T_rig_plane, RIG, TARGET_FRAME, stamp))
    if needle.tip is not None:
        pose = _tip_pose(needle.tip)
        moved = Transform(rotation=pose.orientation)
        moved.translation.x, moved.translation.y, moved.translation.z = _numbers(needle.tip.place)
        stamped = _header(to_stamp(needle.tip.stamp_ns))
        found.append(TransformStamped(header=stamped, child_frame_id=TIP_FRAME, transform=moved))
    return found


def camera_transform(side: str, optical_from_rig: Array, stamp: Time) -> TransformStamped:
    """Return where a camera is in `rig`, of what takes points of `rig` to its frame, (4, 4)."""
    return _transform(np.asarray(np.linalg.inv(optical_from_rig)), RIG, camera_frame(side), stamp)


def camera_frame(side: str) -> str:
    """Return the name of a camera's optical frame."""
    return f"{side}_camera_optical"


def _transform(matrix: Array, parent: str, child: str, stamp: Time) -> TransformStamped:
    message = TransformStamped(header=Header(stamp=stamp, frame_id=parent), child_frame_id=child)
    moved = message.transform
    moved.translation.x, moved.translation.y, moved.translation.z = _numbers(matrix[:3, 3])
    moved.rotation = to_quaternion(matrix[:3, :3].tolist())
    return message


def _tip_pose(tip: SeenTip) -> Pose:
    x, y, z, w = _numbers(tip.quaternion)
    return _pose(tip.place, Quaternion(x=x, y=y, z=z, w=w))


def _pose(place: Array, orientation: Quaternion | None = None) -> Pose:
    return Pose(position=_point(place), orientation=orientation or Quaternion(w=1.0))


def _point(place: Array) -> Point:
    x, y, z = _numbers(place)
    return Point(x=x, y=y, z=z)


def _numbers(values: Array) -> list[float]:
    """Return Python floats: a numpy scalar of another width would go out as garbage."""
    return [float(value) for value in values]


def _look(
    marker: Marker, size: Sequence[float], colour: tuple[float, float, float], opacity: float = 1.0
) -> None:
    marker.scale.x, marker.scale.y, marker.scale.z = size
    red, green, blue = colour
    marker.color = ColorRGBA(r=red, g=green, b=blue, a=opacity)


def _header(stamp: Time) -> Header:
    return Header(stamp=stamp, frame_id=RIG)
