"""ROS time, quality of service and diagnostics, to and from plain data."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from needle_core import component, message_types
from needle_core.component import Delivery
from needle_core.diagnostics import Diagnostic
from needle_core.message_types import rclpy_types

_TYPES = rclpy_types()


def to_qos(delivery: Delivery) -> QoSProfile:
    """Return the QoS profile of a component's row."""
    reliability, durability = ReliabilityPolicy, DurabilityPolicy
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=delivery.depth,
        reliability=reliability.RELIABLE if delivery.reliable else reliability.BEST_EFFORT,
        durability=durability.TRANSIENT_LOCAL if delivery.latched else durability.VOLATILE,
    )


RELIABLE = to_qos(component.RELIABLE)
JOINT_STATES = to_qos(component.JOINT_STATES)
LATCHED = to_qos(component.LATCHED)
HOLD = to_qos(component.BEST_EFFORT)
IMAGES = to_qos(component.IMAGES)
IMAGES_BEST_EFFORT = to_qos(component.IMAGES_BEST_EFFORT)


def to_nanoseconds(stamp: Time) -> int:
    """Return a message's stamp in ns since the clock's epoch, exactly."""
    return message_types.to_nanoseconds(stamp)


def to_stamp(nanoseconds: int) -> Time:
    """Return the message stamp of a time in ns since the clock's epoch.

    Whatever `to_nanoseconds` returned has one. A time beyond is the nearest that a stamp can tell.
    """
    stamp: Time = _TYPES.time(nanoseconds)
    return stamp


def to_diagnostic_status(name: str, hardware_id: str, diagnostic: Diagnostic) -> DiagnosticStatus:
    """Return the message of one line of health; `name` is `node: part`."""
    return DiagnosticStatus(
        level=bytes([diagnostic.level]),
        name=name,
        message=diagnostic.message,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=value) for key, value in diagnostic.values.items()],
    )


def values_of(status: DiagnosticStatus) -> dict[str, str]:
    """Return the key-value pairs of a DiagnosticStatus as a dictionary."""
    return {pair.key: pair.value for pair in status.values}
