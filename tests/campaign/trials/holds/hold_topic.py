"""The hold as messages of `device/hold`."""

from __future__ import annotations

import math
import time

from rclpy.node import Node
from sensor_msgs.msg import Joy

from needle_core.convert import Converter
from needle_core.hold_session import HoldSession
from needle_core.message_types import rclpy_types
from needle_core.ros.conversions import HOLD


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

    def __init__(self, node: Node, owner: str, lifetime: float = math.inf) -> None:
        self._publisher = node.create_publisher(Joy, "device/hold", HOLD)
        self._session = HoldSession(owner, lifetime)
        self._converter = Converter(rclpy_types())

    def publish(self, *, pressed: bool, speed: float) -> None:
        """Say whether the hold is pressed, and at which share of the nominal speed."""
        message = self._session.say(time.time_ns(), pressed=pressed, speed=speed)
        self._publisher.publish(self._converter.to_ros(message))
