"""A graph without DDS: rclpy's `Node` is served from memory, and time passes when it spins."""

from __future__ import annotations

import contextlib
from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from types import SimpleNamespace as Stub
from typing import Any

import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message

from made_up_run import STORE

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=1)
Act = Callable[[], Any]
Taken = tuple[bytes, dict[str, int]]


def type_name(kind: type) -> str:
    return f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"


def sent(number: int, data: bytes = b"", time_ns: int = 1) -> Taken:
    """Return a received message and its DDS metadata."""
    names = ("source_timestamp", "received_timestamp")
    info = dict.fromkeys(names, time_ns) | {"publication_sequence_number": number}
    return data or str(number).encode(), info


class PlayedSubscription(contextlib.nullcontext[None]):
    """Subscription whose queue the test fills."""

    def __init__(
        self, topic: str, callback: Callable[..., None], qos: QoSProfile, lost: Any
    ) -> None:
        super().__init__()
        self.topic, self.callback, self.qos_profile, self.lost = topic, callback, qos, lost
        self.waiting: deque[Taken] = deque()
        self.handle = self

    def take_message(self, *_: object) -> Taken | None:
        return self.waiting.popleft() if self.waiting else None


class PlayedClient:
    """Client whose requests wait until the test answers them."""

    def __init__(self, parameters: dict[str, dict[str, Any]], name: str) -> None:
        self.node, _, self.kind = name.rpartition("/")
        self.parameters = parameters
        self.pending: list[tuple[Any, Any]] = []

    def service_is_ready(self) -> bool:
        return self.node in self.parameters

    def call_async(self, request: Any) -> Any:
        callbacks: list[Any] = []
        future = Stub(add_done_callback=callbacks.append, callbacks=callbacks)
        self.pending.append((request, future))
        return future

    def remove_pending_request(self, future: Any) -> None:
        self.pending = [one for one in self.pending if one[1] is not future]

    def answer(self, number: int = 0) -> None:
        """Answer one of the pending requests."""
        request, future = self.pending.pop(number)
        values = self.parameters[self.node]
        if self.kind == "list_parameters":
            response = Stub(result=Stub(names=list(values)))
        else:
            found = [Parameter(n, value=values[n]).get_parameter_value() for n in request.names]
            response = Stub(values=found)
        future.result = lambda: response
        for callback in future.callbacks:
            callback(future)


class PlayedGraph:
    """Simulated graph around a node under test."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *modules: Any) -> None:
        self.now, self.name = 1000.0, "ours"
        self.end = Stub(requested=False)
        self.types: dict[str, str] = {}
        self.offers: dict[str, list[Any]] = defaultdict(list)
        self.requests: dict[str, list[Any]] = defaultdict(list)
        self.parameters: dict[str, dict[str, Any]] = {}
        self.remaps: dict[str, str] = {}
        self.unmatched: set[str] = set()
        self.subscriptions: list[PlayedSubscription] = []
        self.publishers: list[Any] = []
        self.published: dict[str, list[Any]] = defaultdict(list)
        self.clients: list[PlayedClient] = []
        self.services: dict[str, Callable[[Any, Any], Any]] = {}
        self.logged: list[str] = []
        self._timers: list[list[Any]] = []
        self._plans: list[tuple[float, Act]] = []
        self._on_parameters: list[Callable[[list[Parameter[Any]]], None]] = []
        self._sent: dict[str, int] = defaultdict(int)
        ns = Stub(nanoseconds=0)
        log = dict.fromkeys(("info", "warning", "error"), self.logged.append)
        clock = Stub(monotonic=lambda: self.now, time_ns=lambda: round(self.now * 1e9))
        for module in modules:
            monkeypatch.setattr(module, "time", clock)
        for name, method in {
            "__init__": lambda _, name, **__: setattr(self, "name", name),
            "destroy_node": lambda _: None,
            "get_name": lambda _: self.name,
            "get_fully_qualified_name": lambda _: f"/{self.name}",
            "get_logger": lambda _: Stub(**log),
            "get_clock": lambda _: Stub(now=lambda: ns),
            "get_topic_names_and_types": lambda _: [(n, [t]) for n, t in self.types.items()],
            "count_publishers": lambda _, topic: len(self.offers[topic]),
            "count_subscribers": lambda _, topic: len(self.requests[topic]),
            "get_publishers_info_by_topic": lambda _, topic: list(self.offers[topic]),
            "get_subscriptions_info_by_topic": lambda _, topic: list(self.requests[topic]),
            "get_node_names_and_namespaces": self._nodes,
            "get_parameters_by_prefix": lambda _, __: {"own": Parameter("own", value=1)},
            "create_subscription": self._subscribe,
            "destroy_subscription": lambda _, one: self.subscriptions.remove(one),
            "create_publisher": self._publisher,
            "destroy_publisher": lambda _, one: self.publishers.remove(one),
            "create_client": self._client,
            "destroy_client": lambda _, one: self.clients.remove(one),
            "create_service": lambda _, __, name, answer: self.services.update({name: answer}),
            "create_timer": self._timer,
            "set_parameters": lambda _, changes: self.set_parameters(changes),
            "add_post_set_parameters_callback": lambda _, act: self._on_parameters.append(act),
        }.items():
            monkeypatch.setattr(Node, name, method)

    def _nodes(self) -> list[tuple[str, str]]:
        names = (f"/{self.name}", "/_hidden", *self.parameters)
        return [(name.rpartition("/")[2], name.rpartition("/")[0] or "/") for name in names]

    def _subscribe(self, _: type, topic: str, callback: Any, qos: QoSProfile, **how: Any) -> Any:
        lost = how["event_callbacks"].message_lost
        self.subscriptions.append(PlayedSubscription(topic, callback, qos, lost))
        return self.subscriptions[-1]

    def _publisher(self, _: type, topic: str, qos: Any) -> Any:
        name = self.remaps.get(topic, topic)
        made = Stub(topic_name=name, qos=qos, wait_for_all_acked=lambda _: True)
        made.publish = lambda message: self.published[name].append(message)  # noqa: PLW0108
        made.get_subscription_count = lambda: (
            (name not in self.unmatched) * len(self.requests[name])
        )
        self.publishers.append(made)
        return made

    def _client(self, _: type, name: str) -> PlayedClient:
        self.clients.append(PlayedClient(self.parameters, name))
        return self.clients[-1]

    def _timer(self, period: float, act: Act, **_: object) -> None:
        self._timers.append([self.now + period, period, act])

    # ---- other nodes

    def offer(
        self, topic: str, kind: type, qos: QoSProfile = RELIABLE, node: str = "other"
    ) -> None:
        self.offers[topic].append(self._endpoint(topic, kind, qos, node))

    def request(self, topic: str, kind: type, qos: QoSProfile = RELIABLE) -> None:
        self.requests[topic].append(self._endpoint(topic, kind, qos, "other"))

    def _endpoint(self, topic: str, kind: type, qos: QoSProfile, node: str) -> Any:
        self.types[topic] = type_name(kind)
        type_hash = STORE.hash_rihs01(self.types[topic])
        return Stub(qos_profile=qos, node_name=node, topic_type_hash=type_hash)

    def send(self, topic: str, *messages: Any) -> None:
        """Deliver messages, or bytes, to every subscription of a topic."""
        for message in messages:
            data = message if isinstance(message, bytes) else serialize_message(message)
            self._sent[topic] += 1
            for one in [one for one in self.subscriptions if one.topic == topic]:
                one.callback(*sent(self._sent[topic], data, round(self.now * 1e9)))

    def answer_all(self) -> None:
        for client in tuple(self.clients):
            while client.pending:
                client.answer()

    def set_parameters(self, changes: Sequence[Parameter[Any]]) -> None:
        for act in self._on_parameters:
            act(list(changes))

    # ---- time

    def at(self, time: float, act: Act) -> None:
        """Schedule an action after a delay [s]."""
        self._plans.append((self.now + time, act))

    def run(self, seconds: float) -> None:
        """Advance time, and run all timers and actions that are due."""
        self.now += seconds
        for plan in [p for p in self._plans if p[0] <= self.now]:
            self._plans.remove(plan)
            plan[1]()
        for timer in self._timers:
            while timer[0] <= self.now:
                timer[0] += timer[1]
                timer[2]()

    def host(self, monkeypatch: pytest.MonkeyPatch, module: Any, parameters: Any = None) -> None:
        """Make `main` of a node's module run in this graph, until the end is requested."""

        def spin_once(timeout: float = 0.0, *, timeout_sec: float = 0.0) -> None:
            # Each turn of the executor takes the whole timeout.
            self.run(timeout + timeout_sec)

        def run_node(create: Callable[[], Any], *, spin: Any, **_: object) -> int:
            return int(spin(create(), self.end))

        executor = Stub(add_node=lambda _: None, spin_once=spin_once)
        monkeypatch.setattr(module, "SingleThreadedExecutor", lambda: executor)
        monkeypatch.setattr(module, "run_node", run_node)
        monkeypatch.setattr(module, "NodeParameters", lambda *_: Stub(values=parameters))
