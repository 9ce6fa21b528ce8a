"""Sends a driver what holds up a careless one: long messages, long requests, floods.

`python -m needle_verification.ros.nuisance KIND`: says `begins` when everything is ready, sends
until its input ends, and ends.
"""

from __future__ import annotations

import select
import sys
import time
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Joy
from std_msgs.msg import Bool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from needle_core.errors import UserError
from needle_core.ros.conversions import HOLD, RELIABLE

POINTS = 1_000_000
NAME = 1_000_000
PER_SECOND = 10_000
NUISANCE_KINDS = ("points", "name", "flood")
_LIMIT = 20.0
# Long ones go out one after the other: what is sent at once would be several at once.
_PAUSE = 0.5


def main() -> int:
    """Send one kind of nuisance; returns the exit code."""
    (kind,) = sys.argv[1:]
    rclpy.init()
    node = Node("nuisance")
    send, pause = _prepared(node, kind)
    sys.stdout.write("begins\n")
    sys.stdout.flush()
    due = time.monotonic()
    while not select.select([sys.stdin], [], [], max(due - time.monotonic(), 0.0))[0]:
        send()
        due = max(due + pause, time.monotonic() - _PAUSE)
    node.destroy_node()
    rclpy.try_shutdown()
    return 0


def _prepared(node: Node, kind: str) -> tuple[Callable[[], None], float]:
    """Return what sends once, and how long to wait between two times [s]."""
    if kind == "points":
        way = JointTrajectory(points=[JointTrajectoryPoint(positions=[0.0, 0.0])] * POINTS)
        return _sender(node, JointTrajectory, "device/joint_trajectory", RELIABLE, way), _PAUSE
    if kind == "name":
        hold = Joy(axes=[1.0], buttons=[1])
        hold.header.frame_id = "n" * NAME
        return _sender(node, Joy, "device/hold", HOLD, hold), _PAUSE
    if kind == "flood":
        hold = Joy(axes=[1.0], buttons=[1])
        hold.header.frame_id = "nuisance"
        senders = [
            _sender(node, JointTrajectory, "device/joint_trajectory", RELIABLE, JointTrajectory()),
            _sender(node, Joy, "device/hold", HOLD, hold),
            _sender(node, Bool, "device/estop", RELIABLE, Bool()),
        ]

        def flood() -> None:
            for sender in senders:
                for _ in range(10):
                    sender()

        return flood, 10.0 / PER_SECOND
    raise UserError(f"nuisance {kind!r} is not one of {', '.join(NUISANCE_KINDS)}")


def _sender(node: Node, kind: type, topic: str, qos: Any, message: Any) -> Callable[[], None]:
    publisher = node.create_publisher(kind, topic, qos)
    data = serialize_message(message)
    end = time.monotonic() + _LIMIT
    while publisher.get_subscription_count() == 0:
        if time.monotonic() > end:
            raise UserError(f"nobody listens to {topic}")
        time.sleep(0.01)
    return lambda: publisher.publish(data)


if __name__ == "__main__":
    sys.exit(main())
