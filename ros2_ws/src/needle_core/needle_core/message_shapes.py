"""Shapes of ROS messages: which field holds which attribute of a message, in which form."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from needle_core.message_types import NANOSECONDS, MessageTypes, to_nanoseconds


class Row(NamedTuple):
    """ROS type of a message class, and the conversions to it and back."""

    ros_type: str
    to_ros: Callable[[Any, MessageTypes], Any]
    from_ros: Callable[[Any], Any]


class Codec(NamedTuple):
    """Conversions of a value to a field of a ROS message and back."""

    to_ros: Callable[[Any, MessageTypes], Any]
    from_ros: Callable[[Any], Any]

    def of(self, attribute: str) -> Value:
        """Return the content of a field that holds an attribute of another name."""
        return Value(attribute, self)


class Value(NamedTuple):
    """Content of a field: an attribute of the message."""

    attribute: str
    codec: Codec


class Shape:
    """Fields of a ROS type that hold the attributes of a message; all others are empty or 0.

    Parameters
    ----------
    ros_type : str
        Name of the type.
    fields : Codec, Value or Shape
        Content of each field. A codec alone stands for the attribute of the same name, and a nested
        shape holds attributes of the same message.
    """

    def __init__(self, ros_type: str, **fields: Codec | Value | Shape) -> None:
        self.ros_type = ros_type
        self._values: dict[str, Value] = {}
        self._shapes: dict[str, Shape] = {}
        for name, field in fields.items():
            if isinstance(field, Shape):
                self._shapes[name] = field
            else:
                self._values[name] = field.of(name) if isinstance(field, Codec) else field

    def to_ros(self, message: Any, t: MessageTypes) -> Any:
        """Return a message, or any object with its attributes, as a ROS message."""
        fields = {name: shape.to_ros(message, t) for name, shape in self._shapes.items()}
        for name, (attribute, codec) in self._values.items():
            fields[name] = codec.to_ros(getattr(message, attribute), t)
        return t.make(self.ros_type)(**fields)

    def values(self, message: Any) -> dict[str, Any]:
        """Return the attributes in a ROS message."""
        values: dict[str, Any] = {}
        for name, (attribute, codec) in self._values.items():
            values[attribute] = codec.from_ros(getattr(message, name))
        for name, shape in self._shapes.items():
            values |= shape.values(getattr(message, name))
        return values

    def row(self, kind: type[Any]) -> Row:
        """Return the row of a message class with these attributes."""
        return Row(self.ros_type, self.to_ros, lambda r: kind(**self.values(r)))


def same(kind: Callable[[Any], Any]) -> Codec:
    """Return the codec of a value that a field holds unchanged; `kind` is its Python type."""
    return Codec(lambda value, t: value, kind)


def numbers(dtype: type[np.generic], kind: Callable[[Any], Any] = float) -> Codec:
    """Return the codec of a sequence of numbers."""
    return Codec(lambda values, t: t.array(dtype, values), lambda r: tuple(map(kind, r)))


def components(ros_type: str, names: str) -> Codec:
    """Return the codec of numbers that a nested message holds in fields of these names."""
    return Codec(
        lambda values, t: t.make(ros_type)(**dict(zip(names, values, strict=True))),
        lambda r: tuple(float(getattr(r, name)) for name in names),
    )


def each(codec: Codec | Row) -> Codec:
    """Return the codec of a sequence."""
    return Codec(
        lambda values, t: [codec.to_ros(value, t) for value in values],
        lambda r: tuple(map(codec.from_ros, r)),
    )


def duration(seconds: float, t: MessageTypes) -> Any:
    """Return a builtin_interfaces/Duration."""
    sec, nanosec = divmod(round(seconds * NANOSECONDS), NANOSECONDS)
    return t.make("builtin_interfaces/msg/Duration")(sec=sec, nanosec=nanosec)


BOOL, INT, TEXT = same(bool), same(int), same(str)
TEXTS = Codec(lambda values, t: list(values), tuple)
DOUBLES, FLOATS, INTS = numbers(np.float64), numbers(np.float32), numbers(np.int32, int)
# Without a copy, because images are large and arrive at 60 Hz.
PIXELS = Codec(lambda data, t: t.octets(data), memoryview)
STAMP = Codec(lambda stamp_ns, t: t.time(stamp_ns), to_nanoseconds)
DURATION = Codec(duration, lambda r: int(r.sec) + int(r.nanosec) * 1e-9)
POINT = components("geometry_msgs/msg/Point", "xyz")
VECTOR = components("geometry_msgs/msg/Vector3", "xyz")
QUATERNION = components("geometry_msgs/msg/Quaternion", "xyzw")
COLOUR = components("std_msgs/msg/ColorRGBA", "rgba")

HEADER = Shape("std_msgs/msg/Header", stamp=STAMP.of("stamp_ns"), frame_id=TEXT)
ONLY_STAMP = Shape("std_msgs/msg/Header", stamp=STAMP.of("stamp_ns"))
POSE = Shape("geometry_msgs/msg/Pose", position=POINT, orientation=QUATERNION)
