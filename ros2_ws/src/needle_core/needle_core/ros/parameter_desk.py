"""Answers for a node's fixed parameters in a process of its own, so that no request holds it up.

A request may be of any length, and rclpy has no bound for it: 20,000 names take most of a second.
The process ends with the one that started it, however that ends: it waits for the end of its input.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import select
import subprocess
import sys
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_service import ParameterService
from rclpy.signals import SignalHandlerOptions

from needle_core.ros.base_node import executor_of
from needle_core.ros.parameters import NodeParameters

_LOOK_PERIOD = 0.1
_LONGEST_END = 0.3


class ParameterDesk:
    """The process that answers, seen from the node that it answers for.

    Parameters
    ----------
    node : Node
        Has no parameter services of its own, and parameters that are fixed at start.
    parameters : str
        Its parameter dataclass, as `module:name`.
    """

    def __init__(self, node: Node, parameters: str) -> None:
        values = {name: p.value for name, p in node.get_parameters_by_prefix("").items()}
        words = [node.get_namespace(), node.get_name(), parameters]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "needle_core.ros.parameter_desk", *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            # a terminal's Ctrl-C is for the node
            start_new_session=True,
        )
        assert self._process.stdin is not None
        # A signal to all of a terminal meets it, too, until it has a session of its own.
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(values, default=list).encode() + b"\n")
            self._process.stdin.flush()

    def ready(self, wait: float) -> bool:
        """Return whether it answers from now on, or never will; looks for `wait` at most [s]."""
        assert self._process.stdout is not None
        return bool(select.select([self._process.stdout], [], [], wait)[0])

    def close(self) -> None:
        """End it; one that is still being loaded has nothing to take leave of."""
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(_LONGEST_END if self.ready(0.0) else 0.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()


class _Represented:
    """A node under another's name, for the names of services."""

    def __init__(self, node: Node, name: str) -> None:
        self._node = node
        self._name = name

    def get_name(self) -> str:
        return self._name

    def __getattr__(self, name: str) -> Any:
        return getattr(self._node, name)


def main() -> int:
    """Answer for the node of the arguments until the input ends; returns the exit code."""
    namespace, name, parameters = sys.argv[1:]
    values: dict[str, Any] = json.loads(sys.stdin.readline())
    module, _, kind = parameters.partition(":")
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = Node(
        f"_{name}_parameters",
        namespace=namespace,
        parameter_overrides=[Parameter(key, value=value) for key, value in values.items()],
        start_parameter_services=False,
        enable_rosout=False,
    )
    represented = _Represented(node, f"{namespace.rstrip('/')}/{name}")
    service = ParameterService(represented)
    NodeParameters(node, getattr(importlib.import_module(module), kind))
    executor = executor_of(node)
    print("ready", flush=True)
    while not select.select([sys.stdin], [], [], 0.0)[0]:
        executor.spin_once(timeout_sec=_LOOK_PERIOD)
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()
    del service
    return 0


if __name__ == "__main__":
    sys.exit(main())
