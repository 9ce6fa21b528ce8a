"""Topics of a virtual graph: found after a while, delivered late, queued, lost."""

from __future__ import annotations

import hashlib
import inspect
from collections import deque
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message

from needle_verification.soak.invariants import DISCOVERED_WITHIN
from needle_verification.soak.link_faults import Delivery, LinkFaults, Way
from needle_verification.soak.virtual_world import NANOSECONDS, VirtualProcess, VirtualWorld

# From an endpoint's creation until another process knows it [ns], at least and at most.
_DISCOVERY_NS = (5_000_000, round(DISCOVERED_WITHIN * NANOSECONDS))
TRANSPORT_NS = (50_000, 1_500_000)
"""What a message takes on its way [ns], at least and at most."""
# From a reliable writer's sending to its sending again, where no acknowledgement came [ns].
_RESEND_NS = (20_000_000, 100_000_000)
# Until others take a killed process for gone [ns].
_LEASE_NS = 8_000_000_000


Watcher = Callable[[str, Any], None]
Listener = Callable[[bytes], None]
Careful = Callable[[Callable[[], None]], None]
"""Calls back; a node sets its own, which knows what to do with a failure."""


def plainly(act: Callable[[], None]) -> None:
    """Call back where no node has set its own."""
    act()


class Endpoint:
    """A node's publisher, subscription, service or client, as others find it.

    Parameters
    ----------
    graph : VirtualGraph
        Where it is.
    process : VirtualProcess
        Whose it is.
    node_name : str
        Its node's full name.
    name : str
        Topic or service.
    qos : QoSProfile, optional
        As created; a service has none.
    """

    def __init__(
        self,
        graph: VirtualGraph,
        process: VirtualProcess,
        node_name: str,
        name: str,
        qos: Any = None,
    ) -> None:
        self.graph = graph
        self.process = process
        self.node_name = node_name
        self.topic_name = self.topic = self.srv_name = name
        self.qos_profile = qos
        self.created_ns = graph.world.steady_ns
        self.gone_ns: int | None = None
        self._known_ns: dict[VirtualProcess, int] = {process: self.created_ns}

    def known_ns(self, process: VirtualProcess) -> int:
        """Return when a process comes to know it, steady clock [ns]."""
        if process not in self._known_ns:
            found = "discovery", self.node_name, self.topic_name, process.name
            late_ns = self.graph.world.chance(*found).randint(*_DISCOVERY_NS)
            self._known_ns[process] = max(self.created_ns, process.started_ns) + late_ns
        return self._known_ns[process]

    def is_seen(self, process: VirtualProcess) -> bool:
        """Return whether a process takes it for there."""
        now = self.graph.world.steady_ns
        return (self.gone_ns is None or now < self.gone_ns) and self.known_ns(process) <= now

    @property
    def info(self) -> SimpleNamespace:
        """Answer of rclpy's `get_*_info_by_topic` about it."""
        namespace, _, name = self.node_name.rpartition("/")
        return SimpleNamespace(
            node_name=name, node_namespace=namespace or "/", qos_profile=self.qos_profile
        )


class VirtualGraph:
    """All endpoints of one ROS domain.

    Parameters
    ----------
    world : VirtualWorld
        Its time and chance.
    faults : LinkFaults
        What happens to messages on their way.

    Attributes
    ----------
    digest : hashlib hash
        Of all that was published and called: by whom, when, how long.
    """

    def __init__(self, world: VirtualWorld, faults: LinkFaults) -> None:
        self.world = world
        self.faults = faults
        self.digest = hashlib.sha256()
        self._listeners: dict[tuple[str, str], Listener] = {}
        self._watchers: dict[str, list[Watcher]] = {}
        self.publishers: dict[str, list[VirtualPublisher]] = {}
        self.subscriptions: dict[str, list[VirtualSubscription]] = {}
        self.services: dict[str, list[Any]] = {}

    def watch(self, topic: str, watcher: Watcher) -> None:
        """Call `watcher` with the node's full name and the message, whenever one is published."""
        self._watchers.setdefault(topic, []).append(watcher)

    def listen_at(self, node_name: str, topic: str, listener: Listener) -> None:
        """Call `listener` with the bytes of each message of a topic when a node takes it."""
        self._listeners[node_name, topic] = listener

    def take(self, node_name: str, topic: str, data: bytes) -> None:
        """Show a message that a node takes."""
        listener = self._listeners.get((node_name, topic))
        if listener is not None:
            listener(data)

    def show(self, topic: str, node_name: str, message: Any) -> None:
        """Show a message to who watches its topic."""
        for watcher in self._watchers.get(topic, ()):
            watcher(node_name, message)

    def remove(self, process: VirtualProcess, *, killed: bool) -> None:
        """Take a process' endpoints out; others go on to count those of one that was killed."""
        gone_ns = self.world.steady_ns + (_LEASE_NS if killed else 0)
        for table in (self.publishers, self.subscriptions, self.services):
            for endpoints in table.values():
                for endpoint in endpoints:
                    if endpoint.process is process and endpoint.gone_ns is None:
                        endpoint.gone_ns = gone_ns


class VirtualPublisher(Endpoint):
    """rclpy's Publisher, as far as the nodes use it."""

    def __init__(self, *place: Any, kind: type[Any]) -> None:
        super().__init__(*place)
        self.msg_type = kind
        self._kept: deque[bytes] = deque(maxlen=self.qos_profile.depth)
        self._arrivals: dict[VirtualSubscription, int] = {}
        self._ways: dict[VirtualSubscription, Way] = {}
        self._unacknowledged: dict[VirtualSubscription, deque[tuple[bytes, int]]] = {}
        self.graph.publishers.setdefault(self.topic_name, []).append(self)
        for subscription in self.graph.subscriptions.get(self.topic_name, ()):
            self.send_latched(subscription)

    def publish(self, message: Any) -> None:
        """Send a message, or its bytes."""
        if not self.process.alive:
            return
        graph = self.graph
        now = graph.world.steady_ns
        # Not the bytes: what fills them up between two fields is whatever lay in memory.
        graph.digest.update(f"{now} {self.node_name} {self.topic_name}\n".encode())
        graph.show(self.topic_name, self.node_name, message)
        readers = [
            subscription
            for subscription in graph.subscriptions.get(self.topic_name, ())
            if self._matched_ns(subscription) <= now and self._suits(subscription)
        ]
        latched = _is_latched(self.qos_profile)
        if not (readers or latched):
            return
        data = message if isinstance(message, bytes) else serialize_message(message)
        if latched:
            self._kept.append(data)
        for subscription in readers:
            self._send(subscription, data)

    def get_subscription_count(self) -> int:
        """Return how many subscriptions it knows."""
        there = self.graph.subscriptions.get(self.topic_name, ())
        return sum(1 for one in there if one.is_seen(self.process) and self._suits(one))

    def send_latched(self, subscription: VirtualSubscription) -> None:
        """Send what is kept for late comers, once both know each other."""
        if not (_is_latched(self.qos_profile) and _is_latched(subscription.qos_profile)):
            return

        def send() -> None:
            if self.process.alive:
                for data in self._kept:
                    self._send(subscription, data)

        self.graph.world.call_at(self._matched_ns(subscription) - 1, send)

    def _matched_ns(self, subscription: VirtualSubscription) -> int:
        return max(subscription.known_ns(self.process), self.known_ns(subscription.process))

    def _suits(self, subscription: VirtualSubscription) -> bool:
        """Return whether QoS lets a message pass: a subscription gets no more than is offered."""
        offered, asked = self.qos_profile, subscription.qos_profile
        if asked.reliability == ReliabilityPolicy.RELIABLE != offered.reliability:
            return False
        return not _is_latched(asked) or _is_latched(offered)

    def _send(self, subscription: VirtualSubscription, data: bytes) -> None:
        """Send a message, or queue it behind what a reliable reader has not acknowledged yet."""
        sent = data, self.graph.world.system_ns
        if not self._is_reliable(subscription):
            self._put_on_link(subscription, *sent)
            return
        waiting = self._unacknowledged.setdefault(subscription, deque(maxlen=self._history))
        waiting.append(sent)
        if len(waiting) == 1:
            self._send_waiting(subscription)

    def _send_waiting(self, subscription: VirtualSubscription) -> None:
        """Send in order; what the link loses is sent again, unless newer ones took its place."""
        waiting = self._unacknowledged[subscription]
        while waiting:
            if not self._put_on_link(subscription, *waiting[0]):
                world = self.graph.world
                again = partial(self._send_again, subscription)
                late_ns = self._way(subscription).faults.randint(*_RESEND_NS)
                world.call_after(late_ns, again)
                return
            waiting.popleft()

    def _send_again(self, subscription: VirtualSubscription) -> None:
        if self.process.alive and subscription.process.alive:
            self._send_waiting(subscription)

    @property
    def _history(self) -> int:
        return max(int(self.qos_profile.depth), 1)

    def _is_reliable(self, subscription: VirtualSubscription) -> bool:
        both = self.qos_profile, subscription.qos_profile
        return all(one.reliability == ReliabilityPolicy.RELIABLE for one in both)

    def _put_on_link(self, subscription: VirtualSubscription, data: bytes, sent_ns: int) -> bool:
        """Send a message once; returns whether it arrives."""
        world = self.graph.world
        way = self._way(subscription)
        deliveries = self.graph.faults.deliveries(self.topic_name, data, way)
        for delivery in deliveries:
            arrival = world.steady_ns + way.takes_ns() + delivery.late_ns
            if self._keeps_order(delivery, subscription):
                arrival = max(arrival, self._arrivals.get(subscription, 0))
                self._arrivals[subscription] = arrival

            def arrive(data: bytes = delivery.data, sent_ns: int = sent_ns) -> None:
                subscription.arrive(data, sent_ns)

            world.call_at(arrival, arrive)
        return bool(deliveries)

    def _keeps_order(self, delivery: Delivery, subscription: VirtualSubscription) -> bool:
        return not delivery.overtakes or self._is_reliable(subscription)

    def _way(self, subscription: VirtualSubscription) -> Way:
        way = self._ways.get(subscription)
        if way is None:
            names = self.node_name, self.topic_name, subscription.node_name
            way = self._ways[subscription] = Way(self.graph.world, TRANSPORT_NS, *names)
        return way


class VirtualSubscription(Endpoint):
    """rclpy's Subscription, as far as the nodes use it; its own handle, too."""

    def __init__(self, *place: Any, kind: type[Any], callback: Any, raw: bool) -> None:
        super().__init__(*place)
        self.msg_type = kind
        self.callback = callback
        self._raw = raw
        self._with_info = _takes_two(callback)
        self._queue: deque[tuple[bytes, int]] = deque()
        self.careful: Careful = plainly
        self.handle = self
        self.graph.subscriptions.setdefault(self.topic_name, []).append(self)
        for publisher in self.graph.publishers.get(self.topic_name, ()):
            publisher.send_latched(self)

    def arrive(self, data: bytes, sent_ns: int) -> None:
        """Queue a message; the oldest gives way where there is no room."""
        if not self.process.alive or self.gone_ns is not None:
            return
        if len(self._queue) >= self.qos_profile.depth:
            self._queue.popleft()
        else:
            self.process.do(self._take_next)
        self._queue.append((data, sent_ns))

    def get_publisher_count(self) -> int:
        """Return how many publishers it knows."""
        there = self.graph.publishers.get(self.topic_name, ())
        return sum(1 for one in there if one.is_seen(self.process))

    def __enter__(self) -> VirtualSubscription:
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing: a handle is held while it is used."""

    def take_message(self, _: type[Any], raw: bool) -> tuple[bytes, dict[str, int]] | None:
        """Take the next message as bytes; None where there is none."""
        assert raw
        if not self._queue:
            return None
        data, sent_ns = self._take()
        return data, self._info(sent_ns)

    def _take_next(self) -> None:
        if not self._queue or self.gone_ns is not None:
            return
        data, sent_ns = self._take()
        message = data if self._raw else deserialize_message(data, self.msg_type)
        arguments = (message, self._info(sent_ns)) if self._with_info else (message,)
        self.careful(lambda: self.callback(*arguments))

    def _take(self) -> tuple[bytes, int]:
        data, sent_ns = self._queue.popleft()
        self.graph.take(self.node_name, self.topic_name, data)
        return data, sent_ns

    def _info(self, sent_ns: int) -> dict[str, int]:
        return {"source_timestamp": sent_ns, "received_timestamp": self.graph.world.system_ns}


def _is_latched(qos: QoSProfile) -> bool:
    return bool(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL)


def _takes_two(callback: Any) -> bool:
    try:
        inspect.signature(callback).bind(object(), object())
    except TypeError:
        return False
    return True
