"""Record of what nodes publish, hear, serve, call, declare and report while they are made."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections.abc import Iterator
from types import FrameType
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from code_lines import ROOT
from needle_core.diagnostics import Diagnostic
from needle_core.ros.base_node import DiagnosticsPublisher
from needle_core.ros.parameters import NodeParameters

PUBLISHES, HEARS, SERVES, CALLS = "publishes", "hears", "serves", "calls"
MAKERS = {
    "create_publisher": PUBLISHES,
    "create_subscription": HEARS,
    "create_service": SERVES,
    "create_client": CALLS,
}
"""Methods of rclpy's Node by what they make."""
OPEN_ENDED = {
    "needle_bags/ros/graph_topics.py:_subscribe": "`recorder` subscribes to all topics "
    "that its parameters select.",
    "needle_bags/ros/player.py:_publisher": "`player` publishes the topics of its bag; "
    "commands, holds and targets under `/replay` only.",
    "needle_bags/ros/parameter_snapshots.py:__init__": "`recorder` asks every node for its "
    "parameters.",
}
"""Functions whose endpoints are those of others: what a reader should know of them."""
SOURCES = ROOT / "ros2_ws" / "src"

Place = tuple[str, int]
"""File below a package's folder in `SOURCES`, and line."""


@dataclasses.dataclass(frozen=True)
class Endpoint:
    """One end of a topic or service.

    Attributes
    ----------
    role : str
        PUBLISHES, HEARS, SERVES or CALLS.
    name : str
        As in the graph without a namespace: relative, but for what is absolute.
    type_name : str
        `package/Type`.
    qos : str
        In words; empty for a service.
    """

    role: str
    name: str
    type_name: str
    qos: str


@dataclasses.dataclass
class Noted:
    """Record of what one node did while it was made, in one of its ways to be set.

    Attributes
    ----------
    endpoints : list of Endpoint
        In order, each once.
    parameters : list of type
        Dataclasses that were declared.
    parts : dict of str to list of str
        Parts of its diagnostics, with the keys of their values.
    places : set of Place
        Lines of code that an endpoint was made from.
    """

    endpoints: list[Endpoint] = dataclasses.field(default_factory=list)
    parameters: list[type] = dataclasses.field(default_factory=list)
    parts: dict[str, list[str]] = dataclasses.field(default_factory=dict)
    places: set[Place] = dataclasses.field(default_factory=set)

    def add(
        self, role: str, node: Any, kind: type, name: str, qos: QoSProfile | int | None
    ) -> None:
        """Note an endpoint that is being made, unless it is one of rclpy's own."""
        maker = sys._getframe(2)
        if not _place(maker)[0]:
            return
        self.places |= _places(maker)
        if f"{_place(maker)[0]}:{maker.f_code.co_name}" in OPEN_ENDED:
            return
        endpoint = Endpoint(
            role, _plain_name(name, node.get_name()), type_name(kind), in_words(qos)
        )
        if endpoint not in self.endpoints:
            self.endpoints.append(endpoint)


def type_name(kind: type) -> str:
    """Return `package/Type` of a class of messages or services."""
    return f"{kind.__module__.partition('.')[0]}/{kind.__name__}"


def in_words(qos: QoSProfile | int | None) -> str:
    """Return a quality of service as a reader wants it: `reliable, 10`, `reliable, latched, 1`."""
    if not isinstance(qos, QoSProfile):
        return ""
    words = ["reliable" if qos.reliability == ReliabilityPolicy.RELIABLE else "best effort"]
    if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL:
        words.append("latched")
    return ", ".join([*words, str(qos.depth)])


def _plain_name(name: str, node: str) -> str:
    return name.replace("~", node, 1)


def _place(frame: FrameType) -> Place:
    """Return the line that a frame is at; an empty file's where it is none of the packages."""
    file = frame.f_code.co_filename
    path = file.partition("/ros2_ws/src/")[2]
    return (path.partition("/")[2], frame.f_lineno) if path else ("", 0)


def _places(frame: FrameType | None) -> set[Place]:
    """Return the lines of the packages that led here."""
    found: set[Place] = set()
    while frame is not None:
        found.add(_place(frame))
        frame = frame.f_back
    return found - {("", 0)}


@contextlib.contextmanager
def noting() -> Iterator[Noted]:
    """Note what nodes do while the context lasts.

    It patches rclpy and two of our own classes: of a process that does nothing else.
    """
    noted = Noted()

    def patched_maker(name: str, role: str) -> Any:
        make = getattr(Node, name)

        def note_and_make(self: Node, kind: type, topic: str, *rest: Any, **more: Any) -> Any:
            # A subscription's third argument is the callback.
            at = {PUBLISHES: 0, HEARS: 1}.get(role)
            qos = None if at is None else more.get("qos_profile", (*rest, None, None)[at])
            noted.add(role, self, kind, topic, qos)
            return make(self, kind, topic, *rest, **more)

        return note_and_make

    declare, report = NodeParameters.__init__, DiagnosticsPublisher.set

    def note_and_declare(self: Any, node: Node, parameters: type, *rest: Any) -> None:
        noted.parameters.append(parameters)
        declare(self, node, parameters, *rest)

    def note_and_report(self: Any, part: str, diagnostic: Diagnostic) -> None:
        keys = noted.parts.setdefault(part, [])
        keys += [key for key in diagnostic.values if key not in keys]
        report(self, part, diagnostic)

    with contextlib.ExitStack() as stack:
        for name, role in MAKERS.items():
            stack.enter_context(_patched(Node, name, patched_maker(name, role)))
        stack.enter_context(_patched(NodeParameters, "__init__", note_and_declare))
        stack.enter_context(_patched(DiagnosticsPublisher, "set", note_and_report))
        yield noted


@contextlib.contextmanager
def _patched(owner: Any, name: str, value: Any) -> Iterator[None]:
    before = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)
