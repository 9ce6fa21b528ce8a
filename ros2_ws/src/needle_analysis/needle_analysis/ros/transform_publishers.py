"""/tf and /tf_static, where their message is installed: no wheel on PyPI brings it."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.publisher import Publisher

from needle_core.ros.conversions import LATCHED, RELIABLE


class TransformPublishers:
    """Sends /tf while somebody subscribes, and /tf_static once.

    Parameters
    ----------
    node : Node
        Who sends.
    kind : type
        tf2_msgs' TFMessage.
    """

    def __init__(self, node: Node, kind: type[Any]) -> None:
        self._kind = kind
        self._moving: Publisher[Any] = node.create_publisher(kind, "/tf", RELIABLE)
        self._fixed: Publisher[Any] = node.create_publisher(kind, "/tf_static", LATCHED)

    def moving(self, make: Callable[[], list[TransformStamped]]) -> None:
        """Send what moves, if somebody wants it."""
        if self._moving.get_subscription_count() and (transforms := make()):
            self._moving.publish(self._kind(transforms=transforms))

    def fixed(self, transforms: Iterable[TransformStamped]) -> None:
        """Send what does not move, for whoever comes later, too."""
        self._fixed.publish(self._kind(transforms=list(transforms)))


def transform_publishers(node: Node) -> TransformPublishers | None:
    """Return what sends a node's transforms; None where tf2_msgs is missing."""
    try:
        kind = importlib.import_module("tf2_msgs.msg").TFMessage
    except ImportError:
        return None
    return TransformPublishers(node, kind)
