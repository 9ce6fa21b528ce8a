"""Node of a trial: it listens while the trial waits, and calls services; and its ROS."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor

from needle_core.errors import UserError
from needle_core.process.reach import keep_to_this_machine
from needle_core.ros.whole_node import WholeNode

PATIENCE = 20.0


@contextmanager
def ros(domain: int) -> Iterator[None]:
    """Start ROS in this process and in this domain, and shut it down in the end."""
    # Its hold must not lapse where a node appears.
    keep_to_this_machine(shared_memory=False)
    rclpy.init(args=[], domain_id=domain)
    try:
        yield
    finally:
        rclpy.try_shutdown()


class ListeningNode(WholeNode):
    """A node whose callbacks run where a trial waits for something.

    Parameters
    ----------
    name : str
        The node's.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)

    def look(self, timeout: float = 0.0) -> None:
        """Take one message, waiting for it at most `timeout` [s]."""
        self._executor.spin_once(timeout_sec=timeout)

    def until(self, condition: Callable[[], bool], what: str, patience: float = PATIENCE) -> None:
        """Wait for a condition.

        Raises
        ------
        UserError
            If it does not come within `patience` [s].
        """
        deadline = time.monotonic() + patience
        while not condition():
            if time.monotonic() > deadline:
                raise UserError(f"waited {patience:g} s in vain: {what}{self.state_now()}")
            self.look(0.01)

    def state_now(self) -> str:
        """Return what else to say of a wait in vain."""
        return ""

    def pause(self, seconds: float) -> None:
        """Listen for so long."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.look(0.005)

    def answer_to(self, client: Any, request: Any) -> Any:
        """Return a service's answer to a request; raises as `until`."""
        future = client.call_async(request)
        self.until(future.done, f"an answer from {client.srv_name}")
        return future.result()

    def close(self) -> None:
        """Let go of everything."""
        self._executor.shutdown()
        self.destroy_node()
