"""The console's hold as messages of `device/hold`."""

from __future__ import annotations

import time

from rclpy.node import Node
from sensor_msgs.msg import Joy

from needle_common.ros.conversions import HOLD, to_stamp

OWNER = "console"
"""Name by which the device knows the console's hold."""

LIFETIME = 0.1
"""So long does a message promise the hold: a console that stands still holds no longer [s]."""


class HoldTopic:
    """Publishes the hold; any thread may do so, one at a time.

    Parameters
    ----------
    node : Node
        Gets the publisher.
    """

    def __init__(self, node: Node) -> None:
        self._publisher = node.create_publisher(Joy, "device/hold", HOLD)
        self._last_stamp = 0

    def publish(self, *, pressed: bool, speed: float) -> None:
        """Say whether the hold is pressed, and at which share of the nominal speed."""
        # Stamps must increase whatever the system clock does.
        self._last_stamp = max(time.time_ns(), self._last_stamp + 1)
        message = Joy(axes=[speed if pressed else 0.0, LIFETIME], buttons=[int(pressed)])
        message.header.stamp = to_stamp(self._last_stamp)
        message.header.frame_id = OWNER
        self._publisher.publish(message)
