"""Every message there and back, through rosbags' CDR and through rclpy's."""

import importlib.util
import math
from typing import Any

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore

from needle_core import messages as m
from needle_core.convert import TABLE, Converter, from_ros, ros_type
from needle_core.diagnostics import Level
from needle_core.message_types import rclpy_types, rosbags_types
from needle_core.ros.conversions import to_nanoseconds, to_stamp
from needle_core.status_messages import ControllerStatus, DeviceStatus

STORE = get_typestore(Stores.ROS2_JAZZY)
STAMP = 1_234_567_890_123
TURN = (0.0, 0.6, 0.0, 0.8)
POINT = m.TrajectoryPoint((0.001, -0.5), 0.5, (1.0, 2.0))
MESSAGES = (
    m.JointState(STAMP, ("insertion_joint", "rotation_joint"), (0.01, -2.5), (0.002, 0.0)),
    m.Trajectory(STAMP, ("insertion_joint", "rotation_joint"), (POINT,)),
    m.CommandResult(STAMP, "aborted: hold released"),
    m.HoldState("rig1/person", "18a3f0c2d9", 3, True, 0.5, 0.125),
    m.HoldState("person", "", STAMP, False, 0.0),
    m.HoldState("rig1/person", "", STAMP, False, 0.0),
    m.Joystick(STAMP, (0.5, -1.0), (1, 0, 1)),
    m.EmergencyStop(True),
    m.Point(STAMP, "rig", (0.1, -0.2, 0.3)),
    m.Vector(STAMP, "target_plane", (0.1, -0.2, 0.3)),
    m.Pose(STAMP, "rig", (0.1, -0.2, 0.3), TURN),
    m.PoseWithCovariance(STAMP, "rig", (0.1, -0.2, math.inf), TURN, tuple(np.arange(36.0))),
    m.Path(STAMP, "rig", ((0.1, -0.2, 0.3), (0.4, 0.5, -0.6))),
    m.Transforms((m.Transform(STAMP, "rig", "needle_tip", (0.1, -0.2, 0.3), TURN),)),
    m.Image(STAMP, "left_camera_optical", 2, 3, "mono8", 4, bytes(range(8))),
    m.CompressedImage(STAMP, "left_camera_optical", "jpeg", bytes(range(8))),
    m.CameraInfo(
        stamp_ns=STAMP,
        frame_id="left_camera_optical",
        height=768,
        width=1024,
        distortion_model="plumb_bob",
        d=(0.1, 0.2, 0.0, 0.0, 0.3),
        k=tuple(np.arange(9.0)),
        r=tuple(np.arange(9.0, 18.0)),
        p=tuple(np.arange(12.0)),
        binning_x=2,
        binning_y=4,
        roi=m.RegionOfInterest(10, 20, 30, 40),
    ),
    m.Text("a calibration"),
    m.Markers(
        (
            m.Marker(
                frame_id="rig",
                namespace="shaft",
                number=4,
                kind=4,
                action=0,
                position=(0.1, 0.2, 0.3),
                orientation=TURN,
                scale=(0.6, 0.6, 0.6),
                stamp_ns=STAMP,
                # Of 32 bits there.
                colour=(0.25, 0.5, 0.75, 1.0),
                points=((0.0, 0.0, 0.0), (0.1, -0.2, 0.3)),
            ),
        )
    ),
    m.Status("rig1/device_driver", "device", Level.WARN, "text", {"state": "MOVING"}),
    m.Diagnostics(STAMP, (m.Status("sim_rig", "simulation", Level.OK, "runs", {"a": "1"}),)),
    m.LogLine(STAMP, "warning", "plane_controller", "a line"),
    DeviceStatus(
        source="rig1/device_driver",
        level=Level.WARN,
        text="moves",
        state="MOVING",
        homed=True,
        speed_scale=0.25,
        insertion_m=0.0123,
        command_ns=STAMP,
        simulated=False,
    ),
    ControllerStatus(
        state="STEERING", starts=2, target_point_m=(0.1, -0.2, 0.3), reachable=True, r1_low_m=-0.001
    ),
)


def test_every_kind_of_message_is_tried() -> None:
    assert {type(message) for message in MESSAGES} == set(TABLE)


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
def test_a_message_goes_there_and_back_with_and_without_ros_and_across(message: Any) -> None:
    kind = ros_type(type(message))
    written = STORE.serialize_cdr(Converter(rosbags_types(STORE)).to_ros(message), kind)
    assert from_ros(type(message), STORE.deserialize_cdr(written, kind)) == message
    # No wheel on PyPI brings tf2_msgs.
    if importlib.util.find_spec(kind.partition("/")[0]) is not None:
        types = rclpy_types()
        for data in (serialize_message(Converter(types).to_ros(message)), bytes(written)):
            heard = deserialize_message(data, types.make(kind))
            assert from_ros(type(message), heard) == message


def test_a_plain_marker_looks_like_an_obstacle() -> None:
    ball = m.Marker("rig", "bone", 4, 2, 0, (0.1, 0.2, 0.3), TURN, (0.6, 0.6, 0.6))
    (marker,) = Converter(rclpy_types()).to_ros(m.Markers((ball,))).markers
    color, stamp = marker.color, marker.header.stamp
    assert (color.r, color.g, color.b, color.a) == (0.8, 0.2, 0.2, 0.5)
    assert (stamp.sec, stamp.nanosec, list(marker.points)) == (0, 0, [])


def test_a_hold_s_frame_is_its_source_and_session() -> None:
    joy = rclpy_types().make("sensor_msgs/msg/Joy")()
    joy.header.stamp.nanosec = 7
    for frame_id, source, session in (
        ("rig1/operator/18a3f0", "rig1/operator", "18a3f0"),
        ("operator", "operator", ""),
        ("/by_hand", "/by_hand", ""),
        ("", "", ""),
    ):
        joy.header.frame_id = frame_id
        hold = from_ros(m.HoldState, joy)
        assert (hold.source, hold.session, hold.count) == (source, session, 7)


def test_a_hold_without_button_or_axis_is_a_release() -> None:
    joy = rclpy_types().make("sensor_msgs/msg/Joy")()
    hold = from_ros(m.HoldState, joy)
    assert not hold.pressed
    assert math.isnan(hold.speed_scale)
    assert hold.lifetime == math.inf


def test_every_stamp_has_a_time_and_every_time_the_nearest_stamp() -> None:
    types = rclpy_types()
    make = types.make("builtin_interfaces/msg/Time")
    for sec in (-(2**31), -1, 0, 2**31 - 1):
        for nanosec in (0, 1, 10**9, 2**32 - 1):
            time_ns = to_nanoseconds(make(sec=sec, nanosec=nanosec))
            assert to_nanoseconds(to_stamp(time_ns)) == time_ns
    assert types.time(2**40 * 10**9).sec == 2**31 - 1
    assert types.time(-(2**40) * 10**9).sec == -(2**31)
