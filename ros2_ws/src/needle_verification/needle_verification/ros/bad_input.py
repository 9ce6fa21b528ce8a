"""Sends bad data into a running graph, for the checks that nothing moves from it.

`python -m needle_verification.ros.bad_input KIND`: bad tips or lonely images beside the good ones,
stamped like joint_states, until its input ends.
"""

from __future__ import annotations

import array
import math
import select
import sys

import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PointStamped
from sensor_msgs.msg import Image, JointState

from needle_core.ros.conversions import IMAGES, JOINT_STATES, RELIABLE, to_nanoseconds, to_stamp
from needle_verification.ros.listening_node import ListeningNode

LEFT_IMAGE = "left_image"
# Joint states from one bad message to the next.
_EVERY = 40


class BadInput(ListeningNode):
    """Answers every so many joint states with a bad tip or a left image alone."""

    def __init__(self, kind: str) -> None:
        super().__init__("bad_input")
        self._kind = kind
        self._seen = 0
        self._bad = (
            self.create_publisher(Image, "stereo/left/image_raw", IMAGES)
            if kind == LEFT_IMAGE
            else self.create_publisher(PointStamped, "needle/tip", RELIABLE)
        )
        self.create_subscription(JointState, "joint_states", self._on_joints, JOINT_STATES)

    def _on_joints(self, message: JointState) -> None:
        self._seen += 1
        if self._seen % _EVERY:
            return
        stamp, insertion = message.header.stamp, float(message.position[0])
        self._bad.publish(
            _image(stamp) if self._kind == LEFT_IMAGE else _tip(self._kind, stamp, insertion)
        )


def _tip(kind: str, stamp: Time, insertion: float) -> PointStamped:
    message = PointStamped()
    message.header.stamp = stamp
    message.header.frame_id = "left_camera_optical" if kind == "frame" else "rig"
    scale = 1000.0 if kind == "millimetres" else 1.0
    message.point.x = math.nan if kind == "not_finite" else 0.001 * scale
    message.point.z = max(insertion, 0.005) * scale
    return message


def _image(stamp: Time) -> Image:
    message = Image(height=768, width=1024, encoding="mono8", step=1024)
    # between two exposures: it must not find a partner
    message.header.stamp = to_stamp(to_nanoseconds(stamp) - 7_000_000)
    message.header.frame_id = "left_camera_optical"
    message.data = array.array("B", bytes(1024 * 768))
    return message


def main() -> int:
    """Send one kind of bad data; returns the exit code."""
    (kind,) = sys.argv[1:]
    rclpy.init()
    node = BadInput(kind)
    while not select.select([sys.stdin], [], [], 0.0)[0]:
        node.look(0.05)
    node.close()
    rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
