"""Parameters of all nodes of the graph, and their changes."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from rcl_interfaces.msg import ParameterEvent, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.task import Future

from needle_core.ros import base_node

# Time after which an unanswered request is repeated; it doubles each time [s].
RETRY_AFTER = 1.0


def plain_value(value: ParameterValue) -> Any:
    """Return a parameter value as plain Python; None if it is not set.

    Parameters
    ----------
    value : ParameterValue
        Message from rclpy or rosbags.
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
    """Parameters of each node when it was first discovered, and their changes.

    Parameters
    ----------
    node : Node
        The node that sends the requests; its own parameters are included.
    on_snapshot : callable
        Called with the full name and the parameters of a node.

    Attributes
    ----------
    changes : list of dict
        All later changes (`apply_event`), in order.
    """

    def __init__(self, node: Node, on_snapshot: Callable[[str, dict[str, Any]], None]) -> None:
        self._node = node
        self._on_snapshot = on_snapshot
        self._queries: dict[str, _Query] = {}
        self._values: dict[str, dict[str, Any]] = {}
        self._current: dict[str, dict[str, Any]] = {}
        self.changes: list[dict[str, Any]] = []

    def document(self) -> dict[str, Any]:
        """Return all parameters as a ROS parameter file."""
        return {name: {"ros__parameters": values} for name, values in self._values.items()}

    def apply_event(self, event: ParameterEvent) -> list[dict[str, Any]]:
        """Apply a message of /parameter_events; return its changes.

        A change has `stamp_ns` (ROS time), `node`, `name`, `value` (None if deleted). Parameters
        declared before the first snapshot of a node are part of the snapshot.
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
            full_name = base_node.full_name(namespace, name)
            present.add(full_name)
            if full_name == self._node.get_fully_qualified_name():
                self._store_own(full_name)
            elif full_name not in self._values:
                if full_name not in self._queries:
                    store = partial(self._store, full_name)
                    self._queries[full_name] = _Query(self._node, full_name, store)
                self._queries[full_name].send()
        # Close clients here, because the callback of an answer still uses its client.
        for full_name in [n for n in self._queries if n in self._values or n not in present]:
            self._queries.pop(full_name).close()

    def _store_own(self, full_name: str) -> None:
        if full_name not in self._values:
            own = self._node.get_parameters_by_prefix("")
            self._store(full_name, {name: p.value for name, p in own.items()})

    def _store(self, full_name: str, values: dict[str, Any]) -> None:
        if full_name in self._values:
            return
        self._values[full_name] = {
            name: value for name, value in values.items() if value is not None
        }
        self._current[full_name] = dict(self._values[full_name])
        self._on_snapshot(full_name, self._values[full_name])


class _Query:
    """Requests to one node: the names of its parameters, then their values.

    A request is repeated until it is answered, because an answer can be lost: a server that has not
    discovered the client yet drops it silently.
    """

    def __init__(
        self, node: Node, full_name: str, on_values: Callable[[dict[str, Any]], None]
    ) -> None:
        self._node = node
        self._on_values = on_values
        self._names: list[str] | None = None
        self._list = node.create_client(ListParameters, f"{full_name}/list_parameters")
        self._get = node.create_client(GetParameters, f"{full_name}/get_parameters")
        self._next, self._wait = time.monotonic(), RETRY_AFTER

    def send(self) -> None:
        """Send the next request if it is due, and its service available."""
        now = time.monotonic()
        client: Client[Any, Any] = self._list if self._names is None else self._get
        if now < self._next or not client.service_is_ready():
            return
        self._next, self._wait = now + self._wait, 2.0 * self._wait
        if self._names is None:
            client.call_async(ListParameters.Request()).add_done_callback(self._receive_names)
        else:
            request = GetParameters.Request(names=self._names)
            client.call_async(request).add_done_callback(self._receive_values)

    def close(self) -> None:
        """Destroy the clients."""
        for client in (self._list, self._get):
            self._node.destroy_client(client)

    def _receive_names(self, future: Future[Any]) -> None:
        if self._names is None:
            self._names = list(future.result().result.names)
            self._next, self._wait = time.monotonic(), RETRY_AFTER
            self.send()

    def _receive_values(self, future: Future[Any]) -> None:
        values = [plain_value(value) for value in future.result().values]
        self._on_values(dict(zip(self._names or [], values, strict=False)))
