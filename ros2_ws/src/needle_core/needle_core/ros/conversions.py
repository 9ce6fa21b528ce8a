"""ROS time, quality of service and diagnostics, to and from plain data."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from needle_core import component
from needle_core.component import Delivery
from needle_core.diagnostics import Diagnostic

NANOSECONDS = 1_000_000_000
# A stamp's fields: int32 and uint32, also where more than a second is told in nanoseconds.
_FIRST_SEC, _LAST_SEC, _LAST_NANOSEC = -(2**31), 2**31 - 1, 2**32 - 1


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
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def to_stamp(nanoseconds: int) -> Time:
    """Return the message stamp of a time in ns since the clock's epoch.

    Whatever `to_nanoseconds` returned has one. A time beyond is the nearest that a stamp can tell.
    """
    sec = min(max(nanoseconds // NANOSECONDS, _FIRST_SEC), _LAST_SEC)
    nanosec = min(max(nanoseconds - sec * NANOSECONDS, 0), _LAST_NANOSEC)
    return Time(sec=sec, nanosec=nanosec)


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
