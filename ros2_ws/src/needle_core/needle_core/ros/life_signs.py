"""Signs of life of a node that has nothing to do: what it waits for, and who else is it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rclpy.node import Node

from needle_core.commands.hints import with_commands
from needle_core.diagnostics import Diagnostic, Level
from needle_core.process.claim import WAY_OUT
from needle_core.ros.base_node import STEADY_CLOCK, DiagnosticsPublisher
from needle_core.ros.discovery import publishers_of

WAIT_PERIOD = 5.0
_LOOK_PERIOD = 1.0
_PART = "duplicates"


class LifeSigns:
    """Logs one line at the start, what is waited for every 5 s, and every duplicate by name.

    Parameters
    ----------
    node : Node
        The node that speaks.
    diagnostics : DiagnosticsPublisher
        Where duplicates go, too.
    line : str
        What the node has been started as.
    missing : callable
        Returns what it waits for; empty: nothing.
    alone_on : sequence of str
        Topics that nobody else may publish.
    """

    def __init__(
        self,
        node: Node,
        diagnostics: DiagnosticsPublisher,
        line: str,
        missing: Callable[[], Sequence[str]],
        *,
        alone_on: Sequence[str] = (),
    ) -> None:
        self._node = node
        self._diagnostics = diagnostics
        self._missing = missing
        self._topics = [node.resolve_topic_name(topic) for topic in alone_on]
        self._duplicates = ""
        node.get_logger().info(f"{line} (ROS_DOMAIN_ID {node.context.get_domain_id()})")
        node.create_timer(WAIT_PERIOD, self._tell_missing, clock=STEADY_CLOCK)
        if alone_on:
            node.create_timer(_LOOK_PERIOD, self._look_around, clock=STEADY_CLOCK)

    def _tell_missing(self) -> None:
        missing = self._missing()
        if missing:
            self._node.get_logger().info(f"waiting for {with_commands(missing)}")

    def _look_around(self) -> None:
        found = [
            f"{topic} is published by {' and '.join(publishers_of(self._node, topic))}"
            for topic in self._topics
            if self._node.count_publishers(topic) > 1
        ]
        duplicates = "; ".join(found)
        if duplicates == self._duplicates:
            return
        self._duplicates = duplicates
        if not duplicates:
            self._diagnostics.set(_PART, Diagnostic(Level.OK, "none"))
            return
        text = f"{duplicates}: {WAY_OUT} (one that was killed counts for up to 8 s)"
        self._node.get_logger().warning(text)
        self._diagnostics.set(_PART, Diagnostic(Level.WARN, text))
