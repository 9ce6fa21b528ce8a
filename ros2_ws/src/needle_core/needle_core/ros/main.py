"""Run of a component as a ROS node: what the executables call."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from needle_core.commands.cli import EXIT_DONE
from needle_core.component import Component, RealPort
from needle_core.process.end_request import EndRequest
from needle_core.ros.base_node import LOOK_PERIOD, run_node
from needle_core.ros.component_node import ComponentNode


def run_component(
    name: str,
    parameters: type[Any],
    make: Callable[[Any, str], Component],
    *,
    help_text: str,
    ports: Callable[[Any], Mapping[str, RealPort]] = lambda _: {},
    interrupted: int = EXIT_DONE,
    shared_memory: bool = True,
) -> int:
    """Run a component as a node until it or a signal ends it; `--help` explains it instead.

    Parameters
    ----------
    name : str
        Name of the node.
    parameters : type
        The component's settings dataclass: the node's parameters.
    make : callable
        Makes the component from its settings and the node's full name.
    help_text : str
        What the node does, its topics and services: the first part of `--help`.
    ports : callable
        Returns the real ports of the component for its settings.
    interrupted : int
        Exit code where a signal ended what was not done yet.
    shared_memory : bool
        Whether messages may go through shared memory, as images must.

    Returns
    -------
    int
        The component's exit code; 2 after bad parameters, 3 after an internal error.
    """
    return run_node(
        lambda: ComponentNode(name, parameters, make, ports),
        help_text=help_text,
        parameters=parameters,
        spin=partial(_spin, interrupted),
        shared_memory=shared_memory,
    )


def _spin(interrupted: int, node: Node, end: EndRequest) -> int:
    assert isinstance(node, ComponentNode)
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    asked = False
    try:
        while node.exit is None:
            if end.wanted and not asked:
                asked = True
                node.stop()
            executor.spin_once(timeout_sec=LOOK_PERIOD)
    finally:
        node.close()
        executor.shutdown()
    if node.exit.text:
        print(f"{node.get_name()}: {node.exit.text}", file=sys.stderr)
    # Others end on the same signal: what failed for want of them was interrupted.
    return interrupted if end.wanted and node.exit.code else node.exit.code
