"""Names of the nodes of a graph."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node

# What the graph calls a node whose endpoint has come and whose name has not.
_UNKNOWN = "_NODE_NAME_UNKNOWN_"
_NAMELESS = "a node of yet unknown name"


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
    return [_name_of(info) or _NAMELESS for info in infos]


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
    return [name for info in infos if (name := _name_of(info))]


def _name_of(info: Any) -> str:
    """Return the full name of an endpoint's node; empty while it is unknown."""
    known = info.node_name != _UNKNOWN
    return full_name(info.node_namespace, info.node_name) if known else ""
