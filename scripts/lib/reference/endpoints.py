"""Topics and services of a component."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

from code_lines import ROOT
from needle_core.component import Component, Delivery, Input, Output
from needle_core.convert import ros_type

PUBLISHES, SUBSCRIBES, SERVES, CALLS = "publishes", "subscribes", "serves", "calls"
SOURCES = ROOT / "ros2_ws" / "src"


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


def endpoints_of(component: Component) -> Iterator[Endpoint]:
    """Yield the topics and the offered services of a component."""
    rows: list[tuple[str, Input | Output]] = [
        *((PUBLISHES, row) for row in component.outputs),
        *((SUBSCRIBES, row) for row in component.inputs),
    ]
    for role, row in rows:
        yield Endpoint(role, row.topic, _type_name(row.message), describe_delivery(row.delivery))
    for offered in component.services:
        yield service(SERVES, offered.name, has_argument=offered.has_argument)


def service(role: str, name: str, *, has_argument: bool = False) -> Endpoint:
    """Return the endpoint of a service."""
    return Endpoint(role, name, f"std_srvs/{'SetBool' if has_argument else 'Trigger'}", "")


def describe_delivery(delivery: Delivery) -> str:
    """Return a quality of service as text: `reliable, 10`, `reliable, latched, 1`."""
    words = ["reliable" if delivery.reliable else "best effort"]
    if delivery.latched:
        words.append("latched")
    return ", ".join([*words, str(delivery.depth)])


def _type_name(message: type[Any]) -> str:
    """Return `package/Type` of a message class."""
    return ros_type(message).replace("/msg/", "/")
