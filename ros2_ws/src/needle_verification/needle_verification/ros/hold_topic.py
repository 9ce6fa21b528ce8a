"""The hold as messages of `device/hold`."""

from __future__ import annotations

import time

from rclpy.node import Node
from sensor_msgs.msg import Joy

from needle_core.ros.conversions import HOLD, to_stamp


class HoldTopic:
    """Publishes the hold; any thread may do so, one at a time.

    Parameters
    ----------
    node : Node
        Gets the publisher.
    owner : str
        Name by which the device knows whose hold it is.
    lifetime : float, optional
        How long a message promises the hold [s]; the device's own if none is given.
    """

    def __init__(self, node: Node, owner: str, lifetime: float | None = None) -> None:
        self._publisher = node.create_publisher(Joy, "device/hold", HOLD)
        self._owner = owner
        self._promise = [] if lifetime is None else [lifetime]
        self._last_stamp = 0

    def publish(self, *, pressed: bool, speed: float) -> None:
        """Say whether the hold is pressed, and at which share of the nominal speed."""
        # Stamps must increase whatever the system clock does.
        self._last_stamp = max(time.time_ns(), self._last_stamp + 1)
        axes = [speed if pressed else 0.0, *self._promise]
        message = Joy(axes=axes, buttons=[int(pressed)])
        message.header.stamp = to_stamp(self._last_stamp)
        message.header.frame_id = self._owner
        self._publisher.publish(message)
