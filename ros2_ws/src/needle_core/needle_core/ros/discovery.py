"""Tell whether the nodes that this one works with have found it: what is sent before is lost.

Two nodes learn of each other one after the other. A subscription that its publisher does not know
yet gets nothing, and neither side can tell. So whoever makes things happen asks first.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Any

from rclpy.client import Client
from rclpy.node import Node
from rclpy.publisher import Publisher
from type_description_interfaces.srv import GetTypeDescription

from needle_core.ros.question import Question

RECORDER = "recorder"
# The part of the recorder's diagnostics that names the nodes whose parameters are in the bag.
PARAMETERS_OF = "parameters_of"
# A question that any node answers at once: there is no such type.
NO_TYPE = GetTypeDescription.Request(type_name="none/msg/None", type_hash="RIHS01_" + "0" * 64)
# What the graph calls a node whose endpoint has come and whose name has not.
_UNKNOWN = "_NODE_NAME_UNKNOWN_"
_NAMELESS = "a node of yet unknown name"


def unrecorded(node: Node, publishers: Iterable[Publisher[Any]]) -> list[str]:
    """Return what `node` publishes without a node named `recorder` listening, as `recorder of T`.

    A first message that is sent before the recorder's subscription is known here is not in the
    bag: whoever makes things happen waits until this is empty.

    Parameters
    ----------
    node : Node
        The node that publishes.
    publishers : iterable of Publisher
        Its publishers.
    """
    return [
        f"recorder of {publisher.topic_name}"
        for publisher in publishers
        if RECORDER not in _listeners(node, publisher.topic_name)
    ]


def full_name(namespace: str, name: str) -> str:
    """Return a node's fully qualified name."""
    return f"{namespace.rstrip('/')}/{name}"


def signature(node: Node) -> str:
    """Return how a node signs what it says of its health: its full name without the first slash."""
    return str(node.get_fully_qualified_name()).lstrip("/")


def publishers_of(node: Node, topic: str) -> list[str]:
    """Return the full names of the nodes that publish a topic, one for each publisher.

    Parameters
    ----------
    node : Node
        The node that asks.
    topic : str
        Its name as the node would give it.
    """
    infos = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    return [
        _NAMELESS if info.node_name == _UNKNOWN else full_name(info.node_namespace, info.node_name)
        for info in infos
    ]


def subscribers_of(node: Node, topic: str) -> list[str]:
    """Return the full names of the nodes that receive a topic, one for each subscription.

    Parameters
    ----------
    node : Node
        The node that asks.
    topic : str
        Its name as the node would give it.
    """
    infos = node.get_subscriptions_info_by_topic(node.resolve_topic_name(topic))
    return [
        full_name(info.node_namespace, info.node_name)
        for info in infos
        if info.node_name != _UNKNOWN
    ]


def _listeners(node: Node, topic: str) -> set[str]:
    infos = node.get_subscriptions_info_by_topic(node.resolve_topic_name(topic))
    return {info.node_name for info in infos}


class AnsweringNodes:
    """Which nodes have learnt of everything that this node has created.

    Nodes learn of each other's endpoints in the order of their creation. Who answers a question
    by a client that was created last knows all that was created before.

    Parameters
    ----------
    node : Node
        The node that asks, after it has created its publishers and subscriptions.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._clients: dict[str, Client[Any, Any]] = {}
        self._questions: dict[str, Question] = {}
        self._answered: set[str] = set()

    def all_of(self, names: set[str]) -> bool:
        """Ask nodes (full names) that have not answered yet; return whether all have."""
        for name in names - self._answered:
            if name not in self._clients:
                self._clients[name] = self._node.create_client(
                    # every node has it in its own process
                    GetTypeDescription,
                    f"{name}/get_type_description",
                )
                self._questions[name] = Question(
                    self._clients[name], partial(self._take_answer, name)
                )
            self._questions[name].ask(NO_TYPE)
        return names <= self._answered

    def close(self) -> None:
        """Drop the clients."""
        for client in self._clients.values():
            self._node.destroy_client(client)
        self._clients.clear()
        self._questions.clear()

    def _take_answer(self, name: str, _: Any) -> None:
        self._answered.add(name)
