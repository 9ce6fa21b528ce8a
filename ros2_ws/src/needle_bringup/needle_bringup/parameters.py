"""The parameters of every node of the graph: as they are when it can first answer, and changes."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import ParameterEvent, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.task import Future

from needle_common import partners_node

GIVE_UP_AFTER = 30.0
# An answer can be lost when the node that gives it does not know the client yet [s].
ASK_AGAIN = 0.5

_FIELDS = {
    ParameterType.PARAMETER_BOOL: "bool_value",
    ParameterType.PARAMETER_INTEGER: "integer_value",
    ParameterType.PARAMETER_DOUBLE: "double_value",
    ParameterType.PARAMETER_STRING: "string_value",
    ParameterType.PARAMETER_BYTE_ARRAY: "byte_array_value",
    ParameterType.PARAMETER_BOOL_ARRAY: "bool_array_value",
    ParameterType.PARAMETER_INTEGER_ARRAY: "integer_array_value",
    ParameterType.PARAMETER_DOUBLE_ARRAY: "double_array_value",
    ParameterType.PARAMETER_STRING_ARRAY: "string_array_value",
}


def plain_value(value: ParameterValue) -> Any:
    """Return a parameter's value as YAML can hold it; None where it is not set.

    Parameters
    ----------
    value : ParameterValue
        rclpy's, or a bag's as rosbags has it.
    """
    field = _FIELDS.get(value.type)
    if field is None:
        return None
    plain = getattr(value, field)
    if isinstance(plain, (bool, int, float, str)):
        return plain
    items = plain if isinstance(plain, list) else plain.tolist()
    return [int.from_bytes(x, "little") if isinstance(x, bytes) else x for x in items]


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
        self._first_seen: dict[str, float] = {}
        self._asked: dict[str, float] = {}
        self._settled: set[str] = set()
        self._clients: dict[str, tuple[Client, Client]] = {}
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
        """Ask nodes that have appeared since the last call and can answer now."""
        for name, namespace in self._node.get_node_names_and_namespaces():
            if name.startswith("_"):
                continue
            full_name = partners_node.full_name(namespace, name)
            if full_name == self._node.get_fully_qualified_name():
                self._take_own(full_name)
            elif full_name in self._settled:
                self._drop_clients(full_name)
            else:
                self._ask_when_ready(full_name)

    def _take_own(self, full_name: str) -> None:
        if full_name not in self._values:
            own = self._node.get_parameters_by_prefix("")
            self._take(full_name, {name: p.value for name, p in own.items()})

    def _ask_when_ready(self, full_name: str) -> None:
        now = time.monotonic()
        if full_name not in self._clients:
            self._first_seen[full_name] = now
            self._clients[full_name] = (
                self._node.create_client(ListParameters, f"{full_name}/list_parameters"),
                self._node.create_client(GetParameters, f"{full_name}/get_parameters"),
            )
        names_of, values_of = self._clients[full_name]
        if now - self._first_seen[full_name] > GIVE_UP_AFTER:
            self._settled.add(full_name)
        elif (
            now - self._asked.get(full_name, -ASK_AGAIN) >= ASK_AGAIN
            and names_of.service_is_ready()
            and values_of.service_is_ready()
        ):
            self._asked[full_name] = now
            future = names_of.call_async(ListParameters.Request())
            future.add_done_callback(lambda answer: self._ask_values(full_name, answer))

    def _ask_values(self, full_name: str, answer: Future) -> None:
        response = answer.result()
        if response is None or full_name not in self._clients:
            return
        names = list(response.result.names)
        future = self._clients[full_name][1].call_async(GetParameters.Request(names=names))
        future.add_done_callback(lambda values: self._take_values(full_name, names, values))

    def _take_values(self, full_name: str, names: list[str], answer: Future) -> None:
        response = answer.result()
        if response is None or full_name in self._settled:
            return
        values = [plain_value(value) for value in response.values]
        self._settled.add(full_name)
        self._take(full_name, dict(zip(names, values, strict=False)))

    def _take(self, full_name: str, values: dict[str, Any]) -> None:
        self._values[full_name] = {
            name: value for name, value in values.items() if value is not None
        }
        self._now[full_name] = dict(self._values[full_name])
        self._on_snapshot(full_name, self._values[full_name])

    def _drop_clients(self, full_name: str) -> None:
        for client in self._clients.pop(full_name, ()):
            self._node.destroy_client(client)
