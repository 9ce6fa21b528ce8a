"""ROS time, quality of service and diagnostics, to and from plain data."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from needle_core.component import Delivery
from needle_core.diagnostics import Diagnostic

NANOSECONDS = 1_000_000_000
# A stamp's fields: int32 and uint32, also where more than a second is told in nanoseconds.
_FIRST_SEC, _LAST_SEC, _LAST_NANOSEC = -(2**31), 2**31 - 1, 2**32 - 1


def _last(depth: int, reliability: ReliabilityPolicy) -> QoSProfile:
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=reliability)


RELIABLE = _last(10, ReliabilityPolicy.RELIABLE)
# Four seconds of them, at 50 Hz, for a receiver that stands still meanwhile.
JOINT_STATES = _last(200, ReliabilityPolicy.RELIABLE)
LATCHED = _last(1, ReliabilityPolicy.RELIABLE)
LATCHED.durability = DurabilityPolicy.TRANSIENT_LOCAL
HOLD = _last(1, ReliabilityPolicy.BEST_EFFORT)
# What a device hears while others flood the topic, from one look to the next: all of it counts.
HOLDS_HEARD = _last(100, ReliabilityPolicy.BEST_EFFORT)
IMAGES = _last(5, ReliabilityPolicy.RELIABLE)
IMAGES_BEST_EFFORT = _last(2, ReliabilityPolicy.BEST_EFFORT)


def to_qos(delivery: Delivery) -> QoSProfile:
    """Return the QoS profile of a component's row."""
    if delivery.latched:
        return LATCHED
    reliable = ReliabilityPolicy.RELIABLE
    return _last(delivery.depth, reliable if delivery.reliable else ReliabilityPolicy.BEST_EFFORT)


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
