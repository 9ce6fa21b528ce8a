"""Topics of a virtual graph: found after a while, delivered late, queued, lost."""

from __future__ import annotations

import hashlib
import inspect
from collections import Counter, deque
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message

from needle_verification.ros.soak.virtual_endpoint import Endpoint, Sample
from needle_verification.soak.link_faults import Delivery, LinkFaults, Way
from needle_verification.soak.virtual_world import VirtualProcess, VirtualWorld

TRANSPORT_NS = (50_000, 1_500_000)
"""What a message takes on its way [ns], at least and at most."""
# From a reliable writer's sending to its sending again, where no acknowledgement came [ns].
_RESEND_NS = (20_000_000, 100_000_000)
# Until others take a killed process for gone [ns].
_LEASE_NS = 8_000_000_000


Watcher = Callable[[str, Any], None]
Listener = Callable[[str, Sample], None]
Careful = Callable[[Callable[[], None]], None]
"""Calls back; a node sets its own, which knows what to do with a failure."""


def plainly(act: Callable[[], None]) -> None:
    """Call back where no node has set its own."""
    act()


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
    overflows : Counter of tuple of str
        Messages that a node's queue had no room for, by the node's full name and the topic.
    """

    def __init__(self, world: VirtualWorld, faults: LinkFaults) -> None:
        self.world = world
        self.faults = faults
        self.digest = hashlib.sha256()
        self.overflows: Counter[tuple[str, str]] = Counter()
        self._listeners: dict[str, Listener] = {}
        self._watchers: dict[str, list[Watcher]] = {}
        self.publishers: dict[str, list[VirtualPublisher]] = {}
        self.subscriptions: dict[str, list[VirtualSubscription]] = {}
        self.services: dict[str, list[Any]] = {}

    def watch(self, topic: str, watcher: Watcher) -> None:
        """Call `watcher` with the node's full name and the message, whenever one is published."""
        self._watchers.setdefault(topic, []).append(watcher)

    def listen_at(self, node_name: str, listener: Listener) -> None:
        """Call `listener` with the topic of each message that a node takes, and the message."""
        self._listeners[node_name] = listener

    def take(self, node_name: str, topic: str, sample: Sample) -> None:
        """Show a message that a node takes."""
        listener = self._listeners.get(node_name)
        if listener is not None:
            listener(topic, sample)

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

    def __init__(self, graph: VirtualGraph, *place: Any, kind: type[Any]) -> None:
        super().__init__(*place)
        self.graph = graph
        self.msg_type = kind
        self._kept: deque[Sample] = deque(maxlen=self.qos_profile.depth)
        self._count = 0
        self._last_ns = 0
        self._arrivals: dict[VirtualSubscription, int] = {}
        self._ways: dict[VirtualSubscription, Way] = {}
        self._unacknowledged: dict[VirtualSubscription, deque[Sample]] = {}
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
        self._count += 1
        readers = [
            subscription
            for subscription in graph.subscriptions.get(self.topic_name, ())
            if self._matched_ns(subscription) <= now and self._suits(subscription)
        ]
        latched = _is_latched(self.qos_profile)
        if not (readers or latched):
            return
        data = message if isinstance(message, bytes) else serialize_message(message)
        # A callback takes no time here, and two messages never have one time elsewhere.
        sent_ns = graph.world.system_ns
        self._last_ns = sent_ns + 1 if sent_ns == self._last_ns else sent_ns
        sample = Sample(data, self._last_ns, self._count)
        if latched:
            self._kept.append(sample)
        for subscription in readers:
            self._send(subscription, sample)

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
                for sample in self._kept:
                    self._send(subscription, sample)

        self.graph.world.call_at(self._matched_ns(subscription) - 1, send)

    def _matched_ns(self, subscription: VirtualSubscription) -> int:
        return max(subscription.known_ns(self.process), self.known_ns(subscription.process))

    def _suits(self, subscription: VirtualSubscription) -> bool:
        """Return whether QoS lets a message pass: a subscription gets no more than is offered."""
        offered, asked = self.qos_profile, subscription.qos_profile
        if asked.reliability == ReliabilityPolicy.RELIABLE != offered.reliability:
            return False
        return not _is_latched(asked) or _is_latched(offered)

    def _send(self, subscription: VirtualSubscription, sample: Sample) -> None:
        """Send a message, or queue it behind what a reliable reader has not acknowledged yet."""
        if not self._is_reliable(subscription):
            self._put_on_link(subscription, sample)
            return
        waiting = self._unacknowledged.setdefault(subscription, deque(maxlen=self._history))
        waiting.append(sample)
        if len(waiting) == 1:
            self._send_waiting(subscription)

    def _send_waiting(self, subscription: VirtualSubscription) -> None:
        """Send in order; what the link loses is sent again, unless newer ones took its place."""
        waiting = self._unacknowledged[subscription]
        while waiting:
            if not self._put_on_link(subscription, waiting[0]):
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

    def _put_on_link(self, subscription: VirtualSubscription, sample: Sample) -> bool:
        """Send a message once; returns whether it arrives."""
        world = self.graph.world
        way = self._way(subscription)
        deliveries = self.graph.faults.deliveries(self.topic_name, sample.data, way)
        for delivery in deliveries:
            arrival = world.steady_ns + way.takes_ns() + delivery.late_ns
            if self._keeps_order(delivery, subscription):
                arrival = max(arrival, self._arrivals.get(subscription, 0))
                self._arrivals[subscription] = arrival

            arrived = sample._replace(data=delivery.data)
            world.call_at(arrival, partial(subscription.arrive, arrived))
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

    def __init__(
        self,
        graph: VirtualGraph,
        *place: Any,
        kind: type[Any],
        callback: Any,
        raw: bool,
        on_lost: Any = None,
    ) -> None:
        super().__init__(*place)
        self.graph = graph
        self.msg_type = kind
        self.callback = callback
        self._raw = raw
        self._on_lost = on_lost
        self._lost = 0
        self._tells_loss = False
        self._with_info = _takes_two(callback)
        self._queue: deque[Sample] = deque()
        self.careful: Careful = plainly
        self.handle = self
        self.graph.subscriptions.setdefault(self.topic_name, []).append(self)
        for publisher in self.graph.publishers.get(self.topic_name, ()):
            publisher.send_latched(self)

    def arrive(self, sample: Sample) -> None:
        """Queue a message; the oldest gives way where there is no room."""
        if not self.process.alive or self.gone_ns is not None:
            return
        if len(self._queue) >= self.qos_profile.depth:
            self._queue.popleft()
            self._lose_one()
        else:
            self.process.do(self._take_next)
        self._queue.append(sample)

    def _lose_one(self) -> None:
        self.graph.overflows[self.node_name, self.topic_name] += 1
        self._lost += 1
        # Like a status of DDS: told once, with all that was lost until it is taken.
        if not self._tells_loss and self._on_lost is not None:
            self._tells_loss = True
            self.process.do(self._tell_loss)

    def _tell_loss(self) -> None:
        self._tells_loss = False
        self._on_lost(SimpleNamespace(total_count=self._lost))

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
        sample = self._take()
        return sample.data, self._info(sample)

    def _take_next(self) -> None:
        if not self._queue or self.gone_ns is not None:
            return
        sample = self._take()
        message = sample.data if self._raw else deserialize_message(sample.data, self.msg_type)
        arguments = (message, self._info(sample)) if self._with_info else (message,)
        self.careful(lambda: self.callback(*arguments))

    def _take(self) -> Sample:
        sample = self._queue.popleft()
        self.graph.take(self.node_name, self.topic_name, sample)
        return sample

    def _info(self, sample: Sample) -> dict[str, int]:
        return {
            "source_timestamp": sample.sent_ns,
            "received_timestamp": self.graph.world.system_ns,
            "publication_sequence_number": sample.number,
        }


def _is_latched(qos: QoSProfile) -> bool:
    return bool(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL)


def _takes_two(callback: Any) -> bool:
    try:
        inspect.signature(callback).bind(object(), object())
    except TypeError:
        return False
    return True
