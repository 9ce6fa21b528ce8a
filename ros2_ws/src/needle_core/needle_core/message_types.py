"""Families of ROS message classes: those of rclpy, and those of rosbags' type stores."""

from __future__ import annotations

import array
import functools
import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from needle_core.messages import Quaternion, Vector3

NANOSECONDS = 1_000_000_000
# Range of a stamp's fields: int32 and uint32.
_MIN_SEC, _MAX_SEC, _MAX_NANOSEC = -(2**31), 2**31 - 1, 2**32 - 1


class MessageTypes:
    """Family of message classes, looked up by name.

    Parameters
    ----------
    lookup : callable
        Returns the class of a type name such as `geometry_msgs/msg/Point`.
    array : callable
        Returns a numeric sequence field from numpy type and values.
    byte : callable
        Returns a `byte` field.
    octets : callable
        Returns a `uint8[]` field, without a loop over its elements.
    """

    def __init__(
        self,
        lookup: Callable[[str], Any],
        array: Callable[[type[np.generic], Sequence[float]], Any],
        byte: Callable[[int], Any],
        octets: Callable[[bytes | memoryview], Any],
    ) -> None:
        self.make = functools.cache(lookup)
        self.array = array
        self.byte = byte
        self.octets = octets

    def header(self, stamp_ns: int, frame_id: str = "") -> Any:
        """Return a std_msgs/Header."""
        return self.make("std_msgs/msg/Header")(stamp=self.time(stamp_ns), frame_id=frame_id)

    def header_of(self, message: Any) -> Any:
        """Return the header of a message with a stamp and a frame."""
        return self.header(message.stamp_ns, message.frame_id)

    def time(self, stamp_ns: int) -> Any:
        """Return a builtin_interfaces/Time, clipped to its range."""
        sec = min(max(stamp_ns // NANOSECONDS, _MIN_SEC), _MAX_SEC)
        nanosec = min(max(stamp_ns - sec * NANOSECONDS, 0), _MAX_NANOSEC)
        return self.make("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)

    def duration(self, seconds: float) -> Any:
        """Return a builtin_interfaces/Duration."""
        sec, nanosec = divmod(round(seconds * NANOSECONDS), NANOSECONDS)
        return self.make("builtin_interfaces/msg/Duration")(sec=sec, nanosec=nanosec)

    def point(self, position: Vector3) -> Any:
        """Return a geometry_msgs/Point."""
        x, y, z = position
        return self.make("geometry_msgs/msg/Point")(x=x, y=y, z=z)

    def vector(self, values: Vector3) -> Any:
        """Return a geometry_msgs/Vector3."""
        x, y, z = values
        return self.make("geometry_msgs/msg/Vector3")(x=x, y=y, z=z)

    def quaternion(self, values: Quaternion) -> Any:
        """Return a geometry_msgs/Quaternion."""
        x, y, z, w = values
        return self.make("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w)

    def pose(self, position: Vector3, orientation: Quaternion) -> Any:
        """Return a geometry_msgs/Pose."""
        make = self.make("geometry_msgs/msg/Pose")
        return make(position=self.point(position), orientation=self.quaternion(orientation))


@dataclass(frozen=True)
class Row:
    """ROS type of a message class, and the conversions to its fields and back."""

    ros_type: str
    to_fields: Callable[[Any, MessageTypes], dict[str, Any]]
    from_ros: Callable[[Any], Any]


def to_nanoseconds(stamp: Any) -> int:
    """Return a builtin_interfaces/Time in nanoseconds."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def head(message: Any) -> tuple[int, str]:
    """Return stamp [ns] and frame of a ROS message with a header."""
    return to_nanoseconds(message.header.stamp), message.header.frame_id


def floats(values: Any) -> tuple[float, ...]:
    """Return numbers as Python floats."""
    return tuple(float(value) for value in values)


def xyz(v: Any) -> Vector3:
    """Return the components of a geometry_msgs/Point or Vector3."""
    return (float(v.x), float(v.y), float(v.z))


def xyzw(q: Any) -> Quaternion:
    """Return the components of a geometry_msgs/Quaternion."""
    return (float(q.x), float(q.y), float(q.z), float(q.w))


def rclpy_types() -> MessageTypes:
    """Return the message classes of the installed ROS."""

    def lookup(name: str) -> Any:
        package, kind, short = name.split("/")
        return getattr(importlib.import_module(f"{package}.{kind}"), short)

    def octets(data: bytes | memoryview) -> array.array[int]:
        # rclpy copies everything but an array of bytes element by element.
        field = array.array("B")
        field.frombytes(data)
        return field

    return MessageTypes(
        lookup, lambda _, values: list(values), lambda value: bytes([value]), octets
    )


def rosbags_types(store: Any) -> MessageTypes:
    """Return the message classes of one of rosbags' type stores."""
    return MessageTypes(
        lambda name: store.types[name],
        lambda kind, values: np.array(values, dtype=kind),
        lambda value: value,
        partial(np.frombuffer, dtype=np.uint8),
    )
