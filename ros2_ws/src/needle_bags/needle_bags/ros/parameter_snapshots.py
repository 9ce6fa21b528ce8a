"""The parameters of every node of the graph: as they are when it can first answer, and changes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from rcl_interfaces.msg import ParameterEvent, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from needle_bags.ros.question import Question
from needle_core.ros import base_node


def plain_value(value: ParameterValue) -> Any:
    """Return a parameter's value as YAML can hold it; None where it is not set.

    Parameters
    ----------
    value : ParameterValue
        rclpy's, or a bag's as rosbags has it.
    """
    try:
        plain = parameter_value_to_python(value)
    except RuntimeError:  # of no type that there is
        return None
    return [_plain_element(element) for element in plain] if isinstance(plain, list) else plain


def _plain_element(element: Any) -> Any:
    if isinstance(element, bytes):
        return int.from_bytes(element, "little")
    return element.item() if isinstance(element, np.generic) else element


class ParameterSnapshots:
    """The parameters of all nodes as they were when each node was first seen, and their changes.

    Parameters
    ----------
    node : Node
        The node that asks; its own parameters are taken too.
    on_snapshot : callable
        Called with a node's full name and its parameters, when they have come.

    Attributes
    ----------
    changes : list of dict
        All changes since (`take_event`), in order.
    """

    def __init__(self, node: Node, on_snapshot: Callable[[str, dict[str, Any]], None]) -> None:
        self._node = node
        self._on_snapshot = on_snapshot
        self._questions: dict[str, _Questions] = {}
        self._values: dict[str, dict[str, Any]] = {}
        self._now: dict[str, dict[str, Any]] = {}
        self.changes: list[dict[str, Any]] = []

    def document(self) -> dict[str, Any]:
        """Return all parameters known so far, in the form of a ROS parameter file."""
        return {name: {"ros__parameters": values} for name, values in self._values.items()}

    def take_event(self, event: ParameterEvent) -> list[dict[str, Any]]:
        """Take a message of /parameter_events; return the changes that it tells of.

        Each is `stamp_ns` (ROS time), `node`, `name`, `value` (None: deleted). What a node declares
        before its first snapshot is in the snapshot.
        """
        known = self._now.get(event.node)
        if known is None:
            return []
        told = {
            p.name: plain_value(p.value) for p in (*event.new_parameters, *event.changed_parameters)
        }
        told.update({p.name: None for p in event.deleted_parameters})
        stamp = event.stamp.sec * 1_000_000_000 + event.stamp.nanosec
        changes = [
            {"stamp_ns": stamp, "node": event.node, "name": name, "value": value}
            for name, value in told.items()
            if known.get(name) != value
        ]
        known.update(told)
        self.changes += changes
        return changes

    def poll(self) -> None:
        """Ask the nodes of the graph whose parameters have not come yet."""
        there = set()
        for name, namespace in self._node.get_node_names_and_namespaces():
            if name.startswith("_"):
                continue
            full_name = base_node.full_name(namespace, name)
            there.add(full_name)
            if full_name == self._node.get_fully_qualified_name():
                self._take_own(full_name)
            elif full_name not in self._values:
                self._ask(full_name)
        # Not from an answer's callback: its client is in use there.
        for full_name in [n for n in self._questions if n in self._values or n not in there]:
            self._questions.pop(full_name).close()

    def _take_own(self, full_name: str) -> None:
        if full_name not in self._values:
            own = self._node.get_parameters_by_prefix("")
            self._take(full_name, {name: p.value for name, p in own.items()})

    def _ask(self, full_name: str) -> None:
        questions = self._questions.get(full_name)
        if questions is None:
            questions = _Questions(
                self._node, full_name, lambda values: self._take(full_name, values)
            )
            self._questions[full_name] = questions
        questions.ask()

    def _take(self, full_name: str, values: dict[str, Any]) -> None:
        self._values[full_name] = {
            name: value for name, value in values.items() if value is not None
        }
        self._now[full_name] = dict(self._values[full_name])
        self._on_snapshot(full_name, self._values[full_name])


class _Questions:
    """Asks one node for the names of its parameters, then for their values, as often as needed."""

    def __init__(self, node: Node, full_name: str, take: Callable[[dict[str, Any]], None]) -> None:
        self._node = node
        self._take = take
        self._names: list[str] | None = None
        names_of = node.create_client(ListParameters, f"{full_name}/list_parameters")
        values_of = node.create_client(GetParameters, f"{full_name}/get_parameters")
        self._clients: tuple[Client, ...] = (names_of, values_of)
        self._names_of = Question(names_of, self._take_names)
        self._values_of = Question(values_of, self._take_values)

    def ask(self) -> None:
        """Ask what is not answered yet, when it is time to."""
        if self._names is None:
            self._names_of.ask(ListParameters.Request())
        else:
            self._values_of.ask(GetParameters.Request(names=self._names))

    def close(self) -> None:
        """Drop the clients."""
        for client in self._clients:
            self._node.destroy_client(client)

    def _take_names(self, response: ListParameters.Response) -> None:
        self._names = list(response.result.names)
        self.ask()

    def _take_values(self, response: GetParameters.Response) -> None:
        values = [plain_value(value) for value in response.values]
        self._take(dict(zip(self._names or [], values, strict=False)))
