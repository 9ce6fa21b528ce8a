"""Topics and services of a constructed node."""

from __future__ import annotations

import dataclasses
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from code_lines import ROOT

PUBLISHES, SUBSCRIBES, SERVES, CALLS = "publishes", "subscribes", "serves", "calls"
NAMESPACE = "/of_the_reference"
"""Namespace of the constructed nodes; names outside it are absolute."""
SOURCES = ROOT / "ros2_ws" / "src"
# Packages with the types of rclpy's own endpoints.
_RCLPY = ("rcl_interfaces", "type_description_interfaces")


@dataclasses.dataclass(frozen=True)
class Endpoint:
    """Publisher, subscriber, server or client of a topic or service.

    Attributes
    ----------
    role : str
        PUBLISHES, SUBSCRIBES, SERVES or CALLS.
    name : str
        Name relative to the node's namespace, or absolute.
    type_name : str
        `package/Type`.
    qos : str
        Quality of service in words; empty for a service.
    """

    role: str
    name: str
    type_name: str
    qos: str


def endpoints_of(node: Node) -> list[Endpoint]:
    """Return the distinct endpoints of a node, without those that every ROS node has."""
    found: list[tuple[str, str, type[Any], str]] = [
        *((PUBLISHES, p.topic_name, p.msg_type, in_words(p.qos_profile)) for p in node.publishers),
        *(
            (SUBSCRIBES, s.topic_name, s.msg_type, in_words(s.qos_profile))
            for s in node.subscriptions
        ),
        *((SERVES, s.service_name, s.srv_type, "") for s in node.services),
        *((CALLS, c.service_name, c.srv_type, "") for c in node.clients),
    ]
    ends = (
        Endpoint(role, name.removeprefix(f"{NAMESPACE}/"), type_name(kind), qos)
        for role, name, kind, qos in found
        if type_name(kind).partition("/")[0] not in _RCLPY
    )
    return list(dict.fromkeys(ends))


def type_name(kind: type) -> str:
    """Return `package/Type` of a message or service class."""
    return f"{kind.__module__.partition('.')[0]}/{kind.__name__}"


def in_words(qos: QoSProfile) -> str:
    """Return a quality of service as text: `reliable, 10`, `reliable, latched, 1`."""
    words = ["reliable" if qos.reliability == ReliabilityPolicy.RELIABLE else "best effort"]
    if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL:
        words.append("latched")
    return ", ".join([*words, str(qos.depth)])
