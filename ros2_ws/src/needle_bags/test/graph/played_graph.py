"""A graph without DDS: rclpy's `Node` answers from memory, and time passes when it is spun."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Iterable
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=1)
Taken = tuple[bytes, dict[str, int]]


def type_name(message: Any) -> str:
    kind = message if isinstance(message, type) else type(message)
    return f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"


def endpoint(kind: type, qos: QoSProfile, node: str) -> Any:
    told = STORE.hash_rihs01(type_name(kind))
    return SimpleNamespace(qos_profile=qos, node_name=node, topic_type_hash=told)


class PlayedSubscription:
    """What waits for it is what a test has put there."""

    def __init__(self, topic: str, take: Callable[..., None], qos: QoSProfile, lost: Any) -> None:
        self.topic, self.take, self.qos_profile, self.lost = topic, take, qos, lost
        self.waiting: deque[Taken] = deque()
        self.handle = self

    def __enter__(self) -> None:
        """Nothing has to be held."""

    def __exit__(self, *_: object) -> None:
        """Nothing was held."""

    def take_message(self, *_: object) -> Taken | None:
        return self.waiting.popleft() if self.waiting else None


class PlayedClient:
    """A client whose requests wait until the test has them answered."""

    def __init__(self, graph: PlayedGraph, name: str) -> None:
        self.graph, self.name = graph, name
        self.pending: list[tuple[Any, Any]] = []

    def service_is_ready(self) -> bool:
        return self.name.rpartition("/")[0] in self.graph.parameters

    def call_async(self, request: Any) -> Any:
        callbacks: list[Any] = []
        future = SimpleNamespace(add_done_callback=callbacks.append, callbacks=callbacks)
        self.pending.append((request, future))
        return future

    def remove_pending_request(self, future: Any) -> None:
        self.pending = [(asked, other) for asked, other in self.pending if other is not future]

    def answer(self, number: int = 0) -> None:
        """Answer one of the requests that wait."""
        request, future = self.pending.pop(number)
        values = self.graph.parameters[self.name.rpartition("/")[0]]
        if self.name.endswith("list_parameters"):
            response = SimpleNamespace(result=SimpleNamespace(names=list(values)))
        else:
            found = [Parameter(n, value=values[n]).get_parameter_value() for n in request.names]
            response = SimpleNamespace(values=found)
        future.result = lambda: response
        for callback in future.callbacks:
            callback(future)


class PlayedGraph:
    """What a node of ours sees of other nodes, and they of it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *modules: Any) -> None:
        self.now = 1000.0
        self.name = "ours"
        self.types: dict[str, str] = {}
        self.offers: dict[str, list[Any]] = defaultdict(list)
        self.requests: dict[str, list[Any]] = defaultdict(list)
        self.parameters: dict[str, dict[str, Any]] = {}
        self.remaps: dict[str, str] = {}
        self.unmatched: set[str] = set()
        self.subscriptions: list[PlayedSubscription] = []
        self.publishers: list[Any] = []
        self.heard: dict[str, list[Any]] = defaultdict(list)
        self.clients: list[PlayedClient] = []
        self.services: dict[str, Callable[[Any, Any], Any]] = {}
        self.logged: list[str] = []
        self._timers: list[list[Any]] = []
        self._plans: list[tuple[float, Callable[[], None]]] = []
        self._on_parameters: list[Callable[[list[Parameter[Any]]], None]] = []
        self._sent: dict[str, int] = defaultdict(int)
        clock = SimpleNamespace(
            monotonic=lambda: self.now, time_ns=lambda: round(self.now * 1e9), strftime=str
        )
        for module in modules:
            monkeypatch.setattr(module, "time", clock)
        for name, method in self._methods().items():
            monkeypatch.setattr(Node, name, method)

    def _methods(self) -> dict[str, Callable[..., Any]]:
        log = SimpleNamespace(**dict.fromkeys(("info", "warning", "error"), self.logged.append))
        stamp = SimpleNamespace(nanoseconds=0)
        return {
            "__init__": lambda _, name, **__: setattr(self, "name", name),
            "destroy_node": lambda _: None,
            "get_name": lambda _: self.name,
            "get_fully_qualified_name": lambda _: f"/{self.name}",
            "get_logger": lambda _: log,
            "get_clock": lambda _: SimpleNamespace(now=lambda: stamp),
            "get_topic_names_and_types": lambda _: [(n, [t]) for n, t in self.types.items()],
            "count_publishers": lambda _, topic: len(self.offers[topic]),
            "count_subscribers": lambda _, topic: len(self.requests[topic]),
            "get_publishers_info_by_topic": lambda _, topic: list(self.offers[topic]),
            "get_subscriptions_info_by_topic": lambda _, topic: list(self.requests[topic]),
            "get_node_names_and_namespaces": lambda _: [
                (name.rpartition("/")[2], name.rpartition("/")[0] or "/")
                for name in (f"/{self.name}", "/_hidden", *self.parameters)
            ],
            "get_parameters_by_prefix": lambda _, __: {"own": Parameter("own", value=1)},
            "create_subscription": self._subscribe,
            "destroy_subscription": lambda _, one: self.subscriptions.remove(one),
            "create_publisher": self._publisher,
            "destroy_publisher": lambda _, one: self.publishers.remove(one),
            "create_client": self._client,
            "destroy_client": lambda _, one: self.clients.remove(one),
            "create_service": lambda _, __, name, answer: self.services.update({name: answer}),
            "create_timer": lambda _, period, act, **__: self._timers.append(
                [self.now + period, period, act]
            ),
            "set_parameters": lambda _, changes: self.set_parameters(changes),
            "add_post_set_parameters_callback": lambda _, act: self._on_parameters.append(act),
        }

    def _subscribe(
        self, _: type, topic: str, take: Any, qos: QoSProfile, **how: Any
    ) -> PlayedSubscription:
        made = PlayedSubscription(topic, take, qos, how["event_callbacks"].message_lost)
        self.subscriptions.append(made)
        return made

    def _publisher(self, _: type, topic: str, qos: Any) -> Any:
        name = self.remaps.get(topic, topic)
        made = SimpleNamespace(
            topic_name=name,
            qos=qos,
            publish=partial(self._hear, name),
            get_subscription_count=lambda: (name not in self.unmatched) * len(self.requests[name]),
            wait_for_all_acked=lambda _: True,
        )
        self.publishers.append(made)
        return made

    def _client(self, _: type, name: str) -> PlayedClient:
        self.clients.append(PlayedClient(self, name))
        return self.clients[-1]

    def _hear(self, topic: str, message: Any) -> None:
        self.heard[topic].append(message)

    # ---- what others do

    def offer(
        self, topic: str, kind: type, qos: QoSProfile = RELIABLE, node: str = "other"
    ) -> None:
        self.types[topic] = type_name(kind)
        self.offers[topic].append(endpoint(kind, qos, node))

    def request(self, topic: str, kind: type, qos: QoSProfile = RELIABLE) -> None:
        self.types[topic] = type_name(kind)
        self.requests[topic].append(endpoint(kind, qos, "other"))

    def send(self, topic: str, *messages: Any) -> None:
        """Have every subscription of a topic get messages, or bytes."""
        for message in messages:
            data = message if isinstance(message, bytes) else serialize_message(message)
            self._sent[topic] += 1
            number = self._sent[topic]
            for one in self.subscriptions:
                if one.topic == topic:
                    one.take(*sent(number, data, round(self.now * 1e9)))

    def answer_all(self) -> None:
        for client in tuple(self.clients):
            while client.pending:
                client.answer()

    def set_parameters(self, changes: Iterable[Parameter[Any]]) -> None:
        for act in self._on_parameters:
            act(list(changes))

    # ---- time

    def at(self, time: float, act: Callable[[], Any]) -> None:
        """Plan something for so long from now [s]."""
        self._plans.append((self.now + time, act))

    def run(self, seconds: float) -> None:
        """Let time pass, with all timers and plans that are due."""
        self.now += seconds
        for plan in [p for p in self._plans if p[0] <= self.now]:
            self._plans.remove(plan)
            plan[1]()
        for timer in self._timers:
            while timer[0] <= self.now:
                timer[0] += timer[1]
                timer[2]()

    def executor(self) -> Any:
        """Return an executor whose turns take as long as they may."""

        def spin_once(timeout: float = 0.0, *, timeout_sec: float = 0.0) -> None:
            self.run(timeout + timeout_sec)

        return SimpleNamespace(add_node=lambda _: None, spin_once=spin_once)


def sent(number: int, data: bytes = b"", time_ns: int | None = None) -> Taken:
    """Return what a subscription takes: a message, and what DDS knows of it."""
    time_ns = number if time_ns is None else time_ns
    return data or str(number).encode(), {
        "source_timestamp": time_ns,
        "received_timestamp": time_ns,
        "publication_sequence_number": number,
    }
