"""Basis of the rig's nodes: the node class, names, quality of service, and diagnostics."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from needle_core import component
from needle_core.component import Delivery
from needle_core.convert import to_ros
from needle_core.diagnostics import Diagnostic, Level
from needle_core.errors import UserError
from needle_core.message_types import rclpy_types
from needle_core.messages import Diagnostics, Status

STEADY_CLOCK = Clock(clock_type=ClockType.STEADY_TIME)
_TYPES = rclpy_types()
_MAX_TEXT_LENGTH = 200
# Name that the graph reports for a node while only its endpoint has been discovered.
_UNKNOWN = "_NODE_NAME_UNKNOWN_"
_NAMELESS = "a node of yet unknown name"


class _DestroyedOnFailure(type):
    """Metaclass that destroys a node whose construction fails.

    Otherwise the error's traceback would keep it alive, and other nodes would discover it.
    """

    def __call__(cls: Any, *args: Any, **kwargs: Any) -> Any:
        node = cls.__new__(cls, *args, **kwargs)
        try:
            node.__init__(*args, **kwargs)
        except BaseException:
            # Attributes are missing if rclpy's own constructor has not run yet.
            with contextlib.suppress(AttributeError):
                node.destroy_node()
            raise
        return node


class WholeNode(Node, metaclass=_DestroyedOnFailure):
    """Node that is destroyed if its construction fails."""


def spin_until(node: Node, condition: Callable[[], Any], timeout: float, failure: str = "") -> None:
    """Spin until a condition holds (`bool` never does); raise any `failure` at the timeout [s]."""
    end = time.monotonic() + timeout
    while not condition():
        if time.monotonic() >= end:
            if failure:
                raise UserError(failure)
            return
        rclpy.spin_once(node, timeout_sec=0.02)


# ---- names ------------------------------------------------------------------------------------


def full_name(namespace: str, name: str) -> str:
    """Return the fully qualified name of a node."""
    return f"{namespace.rstrip('/')}/{name}"


def signature(node: Node) -> str:
    """Return the name of a node in its diagnostics: its full name without the leading slash."""
    return str(node.get_fully_qualified_name()).lstrip("/")


def publishers_of(node: Node, topic: str) -> list[str]:
    """Return the full name of the node behind each publisher of a topic."""
    infos = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    return [_name_of(info) or _NAMELESS for info in infos]


def subscribers_of(node: Node, topic: str) -> list[str]:
    """Return the full name of the node behind each subscription of a topic, if it is known."""
    infos = node.get_subscriptions_info_by_topic(node.resolve_topic_name(topic))
    return [name for info in infos if (name := _name_of(info))]


def _name_of(info: Any) -> str:
    """Return the full name of an endpoint's node; empty while it is unknown."""
    known = info.node_name != _UNKNOWN
    return full_name(info.node_namespace, info.node_name) if known else ""


# ---- quality of service, key-value pairs ------------------------------------------------------


def to_qos(delivery: Delivery) -> QoSProfile:
    """Return the QoS profile of a component's row."""
    reliability, durability = ReliabilityPolicy, DurabilityPolicy
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=delivery.depth,
        reliability=reliability.RELIABLE if delivery.reliable else reliability.BEST_EFFORT,
        durability=durability.TRANSIENT_LOCAL if delivery.latched else durability.VOLATILE,
    )


RELIABLE = to_qos(component.RELIABLE)
JOINT_STATES = to_qos(component.JOINT_STATES)
LATCHED = to_qos(component.LATCHED)
HOLD = to_qos(component.BEST_EFFORT)
IMAGES = to_qos(component.IMAGES)
IMAGES_BEST_EFFORT = to_qos(component.IMAGES_BEST_EFFORT)


def values_of(status: DiagnosticStatus) -> dict[str, str]:
    """Return the key-value pairs of a DiagnosticStatus as a dictionary."""
    return {pair.key: pair.value for pair in status.values}


# ---- diagnostics ------------------------------------------------------------------------------


class DiagnosticsPublisher:
    """Publishes the diagnostics of a node: once a second and on every change.

    Parameters
    ----------
    node : Node
        The node.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._rejections: Counter[str] = Counter()
        self._logged: set[tuple[str, str]] = set()
        self._parts: dict[str, Diagnostic] = {}
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", RELIABLE)
        # Use the steady clock, so that diagnostics continue while simulated time is paused.
        node.create_timer(1.0, lambda: self._publish(self._parts), clock=STEADY_CLOCK)

    def set(self, part: str, diagnostic: Diagnostic) -> None:
        """Update one part; publish at once if its level or message changed."""
        before = self._parts.get(part)
        self._parts[part] = diagnostic
        now = (diagnostic.level, diagnostic.message)
        if before is None or (before.level, before.message) != now:
            self._publish([part])

    def reject(self, source: str, kind: str, why: str) -> None:
        """Count an unusable message or request, and report it under the part `input`.

        Parameters
        ----------
        source : str
            Topic or service.
        kind : str
            Kind of problem; only the first of each kind is logged.
        why : str
            Description of the problem.
        """
        text = f"{source}: refused: {why}"[:_MAX_TEXT_LENGTH]
        self._rejections[source] += 1
        if (source, kind) not in self._logged:
            self._logged.add((source, kind))
            self._node.get_logger().warning(text)
        values = {f"refused {name}": str(count) for name, count in self._rejections.items()}
        message = f"{source}: refused: {kind}"
        self.set("input", Diagnostic(Level.WARN, message, {"last": text, **values}))

    def _publish(self, parts: Iterable[str]) -> None:
        name = signature(self._node)
        statuses = tuple(Status.of(name, part, self._parts[part]) for part in parts)
        stamp_ns = self._node.get_clock().now().nanoseconds
        self._publisher.publish(to_ros(Diagnostics(stamp_ns, statuses), _TYPES))
