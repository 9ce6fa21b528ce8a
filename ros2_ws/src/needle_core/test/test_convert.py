"""Round trip of every message, through the CDR of rosbags and of rclpy."""

import dataclasses
import importlib.util
import itertools
import math
from collections.abc import Mapping
from typing import Any, get_args, get_origin, get_type_hints

import pytest
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore

from needle_core import messages as m
from needle_core.convert import TABLE, from_ros, ros_type, to_ros
from needle_core.diagnostics import Level
from needle_core.message_types import rclpy_types, rosbags_types, to_nanoseconds

STORE = get_typestore(Stores.ROS2_JAZZY)
STAMP = 1_234_567_890_123
TURN = (0.0, 0.6, 0.0, 0.8)
# Fields with a count or an index.
LENGTHS = {"covariance": 36, "d": 5, "k": 9, "r": 9, "p": 12, "colour": 4}
TEXTS = {"severity": "warning", "source": "rig1/person", "session": "18a3f0c2d9"}
_NUMBERS = itertools.cycle(range(3, 99))


def example(hint: Any, name: str = "") -> Any:
    """Return a value of a type whose numbers are all different, exact to three digits."""
    arguments = get_args(hint)
    if hint is int:
        return next(_NUMBERS) + (STAMP if name.endswith("_ns") else 0)
    if hint is float:
        return 0.5 + next(_NUMBERS)
    if hint is str:
        return TEXTS.get(name, f"{name} {next(_NUMBERS)}")
    if hint in (bool, Level):
        return hint(1)
    if dataclasses.is_dataclass(hint):
        hints = get_type_hints(hint)
        rows = [row.name for row in dataclasses.fields(hint)]
        return hint(**{row: example(hints[row], row) for row in rows})  # type: ignore[operator]
    if get_origin(hint) is tuple:
        some = arguments[:1] * LENGTHS.get(name, 2) if arguments[-1] is ... else arguments
        return tuple(example(one, name) for one in some)
    if get_origin(hint) in (dict, Mapping):
        return {"state": "MOVING"}
    return bytes(range(8)) if bytes in (hint, *arguments) else example(arguments[0], name)


MESSAGES = (
    *map(example, TABLE),
    m.JointState(STAMP, ("insertion_joint", "rotation_joint"), (0.01, -2.5)),
    m.HoldState("rig1/person", "", STAMP, False, 0.0),
    m.PoseWithCovariance(-STAMP, "", (0.1, -0.2, math.inf), TURN, (0.0,) * 36),
)


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
def test_a_message_round_trips_with_and_without_ros_and_across(message: Any) -> None:
    kind = ros_type(type(message))
    written = STORE.serialize_cdr(to_ros(message, rosbags_types(STORE)), kind)
    assert from_ros(type(message), STORE.deserialize_cdr(written, kind)) == message
    # No wheel on PyPI contains tf2_msgs.
    if importlib.util.find_spec(kind.partition("/")[0]) is not None:
        types = rclpy_types()
        for data in (serialize_message(to_ros(message, types)), bytes(written)):
            received = deserialize_message(data, types.make(kind))
            assert from_ros(type(message), received) == message


def test_the_frame_of_a_hold_is_its_source_and_session() -> None:
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
            assert to_nanoseconds(types.time(time_ns)) == time_ns
    assert types.time(2**40 * 10**9).sec == 2**31 - 1
    assert types.time(-(2**40) * 10**9).sec == -(2**31)
