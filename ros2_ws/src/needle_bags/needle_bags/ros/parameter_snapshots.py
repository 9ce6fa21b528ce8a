"""Parameters of all nodes of the graph, and their changes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from rcl_interfaces.msg import ParameterEvent, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from needle_bags.ros.repeated_request import RepeatedRequest
from needle_core.ros import node_names


def plain_value(value: ParameterValue) -> Any:
    """Return a parameter value as plain Python; None if it is not set.

    Parameters
    ----------
    value : ParameterValue
        The message of rclpy or of rosbags.
    """
    try:
        plain = parameter_value_to_python(value)
    except RuntimeError:  # unknown type
        return None
    return [_plain_element(element) for element in plain] if isinstance(plain, list) else plain


def _plain_element(element: Any) -> Any:
    if isinstance(element, bytes):
        return int.from_bytes(element, "little")
    return element.item() if isinstance(element, np.generic) else element


class ParameterSnapshots:
    """Parameters of all nodes when each was first discovered, and their changes.

    Parameters
    ----------
    node : Node
        The node that sends the requests; its own parameters are included.
    on_snapshot : callable
        Called with the full name and the parameters of a node.

    Attributes
    ----------
    changes : list of dict
        All changes since (`apply_event`), in order.
    """

    def __init__(self, node: Node, on_snapshot: Callable[[str, dict[str, Any]], None]) -> None:
        self._node = node
        self._on_snapshot = on_snapshot
        self._requests: dict[str, _ParameterRequests] = {}
        self._values: dict[str, dict[str, Any]] = {}
        self._current: dict[str, dict[str, Any]] = {}
        self.changes: list[dict[str, Any]] = []

    def document(self) -> dict[str, Any]:
        """Return all parameters as a ROS parameter file."""
        return {name: {"ros__parameters": values} for name, values in self._values.items()}

    def apply_event(self, event: ParameterEvent) -> list[dict[str, Any]]:
        """Apply a message of /parameter_events; return its changes.

        Each is `stamp_ns` (ROS time), `node`, `name`, `value` (None: deleted). Parameters declared
        before the first snapshot of a node are part of the snapshot.
        """
        known = self._current.get(event.node)
        if known is None:
            return []
        changed = {
            p.name: plain_value(p.value) for p in (*event.new_parameters, *event.changed_parameters)
        }
        changed.update({p.name: None for p in event.deleted_parameters})
        stamp = event.stamp.sec * 1_000_000_000 + event.stamp.nanosec
        changes = [
            {"stamp_ns": stamp, "node": event.node, "name": name, "value": value}
            for name, value in changed.items()
            if known.get(name) != value
        ]
        known.update(changed)
        self.changes += changes
        return changes

    def poll(self) -> None:
        """Request the parameters of nodes that have not answered yet."""
        present = set()
        for name, namespace in self._node.get_node_names_and_namespaces():
            if name.startswith("_"):
                continue
            full_name = node_names.full_name(namespace, name)
            present.add(full_name)
            if full_name == self._node.get_fully_qualified_name():
                self._store_own(full_name)
            elif full_name not in self._values:
                self._request(full_name)
        # Not in the callback of an answer, which uses the client.
        for full_name in [n for n in self._requests if n in self._values or n not in present]:
            self._requests.pop(full_name).close()

    def _store_own(self, full_name: str) -> None:
        if full_name not in self._values:
            own = self._node.get_parameters_by_prefix("")
            self._store(full_name, {name: p.value for name, p in own.items()})

    def _request(self, full_name: str) -> None:
        requests = self._requests.get(full_name)
        if requests is None:
            requests = _ParameterRequests(
                self._node, full_name, lambda values: self._store(full_name, values)
            )
            self._requests[full_name] = requests
        requests.send()

    def _store(self, full_name: str, values: dict[str, Any]) -> None:
        self._values[full_name] = {
            name: value for name, value in values.items() if value is not None
        }
        self._current[full_name] = dict(self._values[full_name])
        self._on_snapshot(full_name, self._values[full_name])


class _ParameterRequests:
    """Requests to one node: the names of its parameters, then their values."""

    def __init__(
        self, node: Node, full_name: str, on_values: Callable[[dict[str, Any]], None]
    ) -> None:
        self._node = node
        self._on_values = on_values
        self._names: list[str] | None = None
        names_of = node.create_client(ListParameters, f"{full_name}/list_parameters")
        values_of = node.create_client(GetParameters, f"{full_name}/get_parameters")
        self._clients: tuple[Client, ...] = (names_of, values_of)
        self._names_of = RepeatedRequest(names_of, self._receive_names)
        self._values_of = RepeatedRequest(values_of, self._receive_values)

    def send(self) -> None:
        """Send the next request if it is due."""
        if self._names is None:
            self._names_of.send(ListParameters.Request())
        else:
            self._values_of.send(GetParameters.Request(names=self._names))

    def close(self) -> None:
        """Destroy the clients."""
        for client in self._clients:
            self._node.destroy_client(client)

    def _receive_names(self, response: ListParameters.Response) -> None:
        self._names = list(response.result.names)
        self.send()

    def _receive_values(self, response: GetParameters.Response) -> None:
        values = [plain_value(value) for value in response.values]
        self._on_values(dict(zip(self._names or [], values, strict=False)))
