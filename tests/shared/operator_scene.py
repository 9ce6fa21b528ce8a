"""A rig that a test plays, and the process of an operator before it."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable
from typing import Generic, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import Joy

from needle_core.files.installed import find_executable
from needle_core.ros.conversions import HOLD, LATCHED

LIMIT = 20.0


class RigNode(Node):
    """What plays a rig; it remembers what was asked and held."""

    def __init__(self, context: Context) -> None:
        super().__init__("played_rig", context=context)
        self.asked: list[str] = []
        self.holds: list[Joy] = []
        self.create_subscription(Joy, "device/hold", self.holds.append, HOLD)
        self.device = self.create_publisher(DiagnosticStatus, "device/status", LATCHED)


Rig = TypeVar("Rig", bound=RigNode)


class OperatorScene(Generic[Rig]):
    """Both of them, in a domain.

    Parameters
    ----------
    domain : int
        ROS_DOMAIN_ID.
    play : callable
        Makes the rig's node.
    command : str
        The operator's executable.
    *words : str
        What stands behind it.
    """

    def __init__(
        self, domain: int, play: Callable[[Context], Rig], command: str, *words: str
    ) -> None:
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.rig = play(self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.rig)
        self.operator = subprocess.Popen(
            [find_executable("needle_bringup", command), *words],
            env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
            stderr=subprocess.PIPE,
            text=True,
        )

    def until(self, condition: Callable[[], object]) -> None:
        """Wait for a condition."""
        deadline = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < deadline, (self.rig.asked, self.rig.holds[-3:])
            self._executor.spin_once(timeout_sec=0.02)

    def close(self) -> None:
        """End the process, then the rig."""
        self.operator.kill()
        self.operator.wait()
        assert self.operator.stderr is not None
        self.operator.stderr.close()
        self._executor.shutdown()
        self.rig.destroy_node()
        self.context.try_shutdown()
