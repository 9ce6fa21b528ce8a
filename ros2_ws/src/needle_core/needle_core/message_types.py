"""Families of ROS message classes: those of rclpy, and those of rosbags' type stores."""

from __future__ import annotations

import array
import functools
import importlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

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

    def time(self, stamp_ns: int) -> Any:
        """Return a builtin_interfaces/Time, clipped to its range."""
        sec = min(max(stamp_ns // NANOSECONDS, _MIN_SEC), _MAX_SEC)
        nanosec = min(max(stamp_ns - sec * NANOSECONDS, 0), _MAX_NANOSEC)
        return self.make("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)


def to_nanoseconds(stamp: Any) -> int:
    """Return a builtin_interfaces/Time in nanoseconds."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


@functools.cache
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

    def lookup(name: str) -> Any:
        # Unlike those of rclpy, these classes have no default values.
        blank = {field: empty(*content) for field, content in store.fielddefs[name][1]}
        return partial(store.types[name], **blank)

    def empty(node: Any, content: Any) -> Any:
        match node.name:
            case "NAME":
                return types.make(content)()
            case "BASE":
                return "" if content[0] == "string" else 0
        return [] if content[0][0].name == "NAME" else np.zeros(0)

    types = MessageTypes(
        lookup,
        lambda kind, values: np.array(values, dtype=kind),
        lambda value: value,
        partial(np.frombuffer, dtype=np.uint8),
    )
    return types
