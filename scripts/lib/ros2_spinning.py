"""Common part of the small `ros2`: waiting for the graph, and giving up in one line."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.node import Node

# How long nodes may take to be found [s]: those of a list, and one that is asked for by name.
SPIN_TIME = 0.5
PATIENCE = 5.0
# How long a service may take: an answer that is lost is lost for good [s].
ANSWER = 10.0


class GraphError(Exception):
    """A refusal, in one line."""


def spin_until(node: Node, condition: Callable[[], Any], timeout: float) -> bool:
    """Spin until the condition holds; return whether it does after `timeout` [s]."""
    end = time.monotonic() + timeout
    while not condition():
        if time.monotonic() >= end:
            return False
        rclpy.spin_once(node, timeout_sec=0.02)
    return True
