"""rclpy's nodes on a virtual graph: what is written for the real ones runs on these unchanged."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

from rcl_interfaces.msg import ParameterEvent
from rclpy.clock import Clock
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.time import Time

from needle_core.errors import UserError
from needle_core.ros.base_node import DiagnosticsPublisher
from needle_core.ros.whole_node import WholeLifecycleNode, WholeNode
from needle_verification.ros.soak.virtual_services import VirtualClient, VirtualService
from needle_verification.ros.soak.virtual_topics import (
    VirtualGraph,
    VirtualPublisher,
    VirtualSubscription,
)
from needle_verification.soak.virtual_timers import VirtualBell, VirtualTimer
from needle_verification.soak.virtual_world import NANOSECONDS, VirtualProcess

_PARAMETER_EVENTS_DEPTH = 1000


@dataclasses.dataclass(frozen=True)
class Place:
    """Graph and process in which the next node is made.

    Attributes
    ----------
    graph : VirtualGraph
        Its domain.
    process : VirtualProcess
        Its process.
    domain_id : int
        What it takes for its ROS_DOMAIN_ID.
    parameters : mapping of str to value
        As of its command line.
    log : callable
        Takes the node's name, the level and the text of what it logs.
    name : str
        The node's name in place of its own; empty: its own.
    topics : mapping of str to str
        Topics by other names.
    """

    graph: VirtualGraph
    process: VirtualProcess
    domain_id: int
    parameters: dict[str, Any]
    log: Callable[[str, str, str], None]
    name: str = ""
    topics: Mapping[str, str] = dataclasses.field(default_factory=dict)


_places: list[Place] = []


@contextlib.contextmanager
def virtual_nodes() -> Iterator[None]:
    """Make nodes of the rig that are created meanwhile virtual ones."""
    before = WholeNode.__bases__, WholeLifecycleNode.__bases__
    WholeNode.__bases__ = (VirtualNode,)
    WholeLifecycleNode.__bases__ = (VirtualLifecycleNode,)
    try:
        yield
    finally:
        WholeNode.__bases__, WholeLifecycleNode.__bases__ = before


@contextlib.contextmanager
def placed(place: Place) -> Iterator[None]:
    """Create nodes at `place`."""
    _places.append(place)
    try:
        yield
    finally:
        _places.pop()


class VirtualContext:
    """rclpy's Context, as far as the nodes use it."""

    def __init__(self, domain_id: int) -> None:
        self._domain_id = domain_id
        self._callbacks: list[Callable[[], None]] = []

    def get_domain_id(self) -> int:
        """Return the domain."""
        return self._domain_id

    def on_shutdown(self, callback: Callable[[], None]) -> None:
        """Call back when the process ends."""
        self._callbacks.append(callback)

    def ok(self) -> bool:
        """Return whether messages can be sent."""
        return True

    def shutdown(self) -> None:
        """Do what the end of a process does."""
        while self._callbacks:
            self._callbacks.pop()()


class _SystemClock:
    """A node's own clock: the system's."""

    def __init__(self, place: Place) -> None:
        self._world = place.graph.world

    def now(self) -> Time:
        return Time(nanoseconds=self._world.system_ns)


class _Logger:
    def __init__(self, place: Place, name: str) -> None:
        self._place, self._name = place, name

    def _tell(self, level: str, text: str) -> None:
        self._place.log(self._name, level, text)

    def debug(self, text: str) -> None:
        self._tell("debug", text)

    def info(self, text: str) -> None:
        self._tell("info", text)

    def warning(self, text: str) -> None:
        self._tell("warning", text)

    def error(self, text: str) -> None:
        self._tell("error", text)


class VirtualNode(Node):
    """rclpy's Node without rcl: parameters are the real ones, all else is the virtual graph's.

    Parameters
    ----------
    node_name : str
        Its name, in the root namespace.
    node_arguments : dict
        Those of rclpy's Node; `parameter_overrides` and `start_parameter_services` count.
    """

    def __init__(self, node_name: str, **node_arguments: Any) -> None:
        self.place = place = _places[-1]
        self._process = place.process
        self._graph = place.graph
        self._full_name = f"/{place.name or node_name}"
        self._context = VirtualContext(place.domain_id)
        self._parameters: dict[str, Any] = {}
        self._descriptors: dict[str, Any] = {}
        self._pre_set_parameters_callbacks: list[Any] = []
        self._on_set_parameters_callbacks: list[Any] = []
        self._post_set_parameters_callbacks: list[Any] = []
        self._allow_undeclared_parameters = False
        given = {name: Parameter(name, value=value) for name, value in place.parameters.items()}
        for one in node_arguments.get("parameter_overrides") or ():
            given[one.name] = one
        self._parameter_overrides = given
        self._clock = _SystemClock(place)
        self._logger = _Logger(place, node_name)
        # What a node's own methods look through.
        self._services: list[Any] = []
        self._parameter_event_publisher = self.create_publisher(
            ParameterEvent, "/parameter_events", _PARAMETER_EVENTS_DEPTH
        )
        self.declare_parameter("use_sim_time", False)

    # ---- names --------------------------------------------------------------------------------

    def get_name(self) -> str:
        """Return the name alone."""
        return self._full_name.rpartition("/")[2]

    def get_namespace(self) -> str:
        """Return the namespace."""
        return self._full_name.rpartition("/")[0] or "/"

    def get_fully_qualified_name(self) -> str:
        """Return the name with its namespace."""
        return self._full_name

    def resolve_topic_name(self, topic: str, *, only_expand: bool = False) -> str:
        """Return a topic's full name."""
        del only_expand
        topic = self.place.topics.get(topic, topic)
        if topic.startswith("~/"):
            return f"{self._full_name}/{topic[2:]}"
        return topic if topic.startswith("/") else f"/{topic}"

    resolve_service_name = resolve_topic_name

    # ---- what it makes ------------------------------------------------------------------------

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **_: Any) -> Any:
        """Make a publisher."""
        return VirtualPublisher(*self._at(topic), _qos(qos_profile), kind=msg_type)

    def create_subscription(
        self,
        msg_type: Any,
        topic: str,
        callback: Any,
        qos_profile: Any,
        *,
        raw: bool = False,
        event_callbacks: SubscriptionEventCallbacks | None = None,
        **_: Any,
    ) -> Any:
        """Make a subscription."""
        subscription = VirtualSubscription(
            *self._at(topic),
            _qos(qos_profile),
            kind=msg_type,
            callback=callback,
            raw=raw,
            on_lost=event_callbacks.message_lost if event_callbacks is not None else None,
        )
        subscription.careful = partial(self.run_guarded, subscription.topic_name)
        return subscription

    def create_service(self, srv_type: Any, srv_name: str, callback: Any, **_: Any) -> Any:
        """Make a service."""
        service = VirtualService(*self._at(srv_name), kind=srv_type, callback=callback)
        service.careful = partial(self.run_guarded, service.srv_name)
        self._services.append(service)
        return service

    def create_client(self, srv_type: Any, srv_name: str, **_: Any) -> Any:
        """Make a client."""
        return VirtualClient(
            self._graph, self._process, srv_type, self.resolve_service_name(srv_name)
        )

    def destroy_subscription(self, subscription: Any) -> bool:
        """Take a subscription out of the graph."""
        subscription.gone_ns = self._graph.world.steady_ns
        return True

    def destroy_client(self, _: Any) -> bool:
        """Forget a client."""
        return True

    def create_timer(
        self, timer_period_sec: float, callback: Any, *, clock: Clock | None = None, **_: Any
    ) -> Any:
        """Make a timer; both clocks go alike, but for jumps, which no timer follows."""
        del clock
        return VirtualTimer(self._process, round(timer_period_sec * NANOSECONDS), callback)

    def create_guard_condition(self, callback: Any, **_: Any) -> Any:
        """Make a guard condition."""
        return VirtualBell(self._process, callback)

    def destroy_node(self) -> None:
        """Take all that it made out of the graph."""
        self._graph.remove(self._process, killed=False)
        self.context.shutdown()

    # ---- what it knows of others --------------------------------------------------------------

    def get_node_names_and_namespaces(self) -> list[tuple[str, str]]:
        """Return the nodes that it knows."""
        there = self._graph.publishers["/parameter_events"]
        infos = [one.info for one in there if one.is_seen(self._process)]
        return [(info.node_name, info.node_namespace) for info in infos]

    def get_topic_names_and_types(self, no_demangle: bool = False) -> list[tuple[str, list[str]]]:
        """Return the topics that it knows, and their types."""
        del no_demangle
        found: dict[str, set[str]] = {}
        for table in (self._graph.publishers, self._graph.subscriptions):
            for name, endpoints in table.items():
                types = {one.type_name for one in endpoints if one.is_seen(self._process)}
                found.setdefault(name, set()).update(types)
        return [(name, sorted(types)) for name, types in sorted(found.items()) if types]

    def count_publishers(self, topic_name: str) -> int:
        """Return how many publishers of a topic it knows."""
        return len(self.get_publishers_info_by_topic(self.resolve_topic_name(topic_name)))

    def get_publishers_info_by_topic(self, topic_name: str, no_mangle: bool = False) -> Any:
        """Return what it knows of a topic's publishers."""
        del no_mangle
        there = self._graph.publishers.get(topic_name, ())
        return [one.info for one in there if one.is_seen(self._process)]

    def get_subscriptions_info_by_topic(self, topic_name: str, no_mangle: bool = False) -> Any:
        """Return what it knows of a topic's subscriptions."""
        del no_mangle
        there = self._graph.subscriptions.get(topic_name, ())
        return [one.info for one in there if one.is_seen(self._process)]

    def _at(self, name: str) -> tuple[Any, ...]:
        return self._graph, self._process, self._full_name, self.resolve_topic_name(name)

    def run_guarded(self, source: str, act: Callable[[], None]) -> None:
        """Run a callback as `NodeExecutor` does: an exception in it does not end the node."""
        try:
            act()
        except UserError:
            raise
        except Exception as error:  # noqa: BLE001 - as there
            kind = type(error).__name__
            text = f"{kind}: {error}"
            DiagnosticsPublisher.of(self).refuse(source, kind, text)
            fail = getattr(self, "fail", None)
            if fail is not None:
                fail(f"{source}: {text}")


class VirtualLifecycleNode(VirtualNode, LifecycleNode):
    """rclpy's LifecycleNode without rcl."""

    def __init__(self, node_name: str, **node_arguments: Any) -> None:
        VirtualNode.__init__(self, node_name, **node_arguments)
        self._lifecycle_state = "unconfigured"

    def trigger_configure(self) -> Any:
        """Go from unconfigured to inactive."""
        return self._go("inactive", self.on_configure)

    def trigger_activate(self) -> Any:
        """Go from inactive to active."""
        return self._go("active", self.on_activate)

    def _go(self, state: str, transition: Callable[[LifecycleState], Any]) -> Any:
        result = transition(LifecycleState(self._lifecycle_state, 0))
        if result == TransitionCallbackReturn.SUCCESS:
            self._lifecycle_state = state
        return result

    def destroy_node(self) -> None:
        """Destroy the node."""
        VirtualNode.destroy_node(self)


def _qos(profile: Any) -> QoSProfile:
    return profile if isinstance(profile, QoSProfile) else QoSProfile(depth=profile)
