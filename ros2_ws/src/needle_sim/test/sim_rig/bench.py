"""A sim_rig and whoever it works with on one executor."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from needle_sim.ros.sim_rig import SimRigNode

LIMIT = 20.0


class SimRigBench:
    """Turns both until something has come."""

    def __init__(self, context: Context, **parameters: Any) -> None:
        self.sim = SimRigNode(
            context=context,
            parameter_overrides=[Parameter(k, value=v) for k, v in parameters.items()],
        )
        self._executor = SingleThreadedExecutor(context=context)
        self._nodes: list[Node] = []
        self.join(self.sim)

    def join(self, node: Node) -> None:
        self._executor.add_node(node)
        self._nodes.append(node)

    def look(self, most: float = 0.01) -> None:
        self._executor.spin_once(timeout_sec=min(self.sim.turns(), most))

    def heard(self) -> object:
        """What to say when something does not come."""
        return ""

    def until(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < deadline, f"timed out: {what}; {self.heard()}"
            self.look()

    def close(self) -> None:
        self.sim.close()
        self._executor.shutdown()
        for node in self._nodes:
            node.destroy_node()
