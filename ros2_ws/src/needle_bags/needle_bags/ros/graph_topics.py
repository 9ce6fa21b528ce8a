"""Subscriptions to selected topics of the graph, with serialized messages."""

from __future__ import annotations

import collections
import time
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from rclpy.subscription import Subscription

from needle_bags.format.message_definitions import full_definition, message_class
from needle_bags.format.message_loss import SequenceGaps
from needle_bags.format.topic_choice import TopicChoice
from needle_bags.reading.bag_messages import IMAGE_TYPES
from needle_bags.recording.recording import Received
from needle_bags.ros.conversions import offered_qos, strictest_request
from needle_core.files.bag_topic import BagTopic

# Time limit of one poll of the graph; the next poll continues [s].
GRAPH_TIME = 0.05
# Time limit for handling the queued messages of one topic, so that other topics get their turn [s].
TURN = 0.02
# Fast DDS keeps at most this many by default; a burst during a poll must fit.
DEPTH = 5000
# One second of camera images. Fast DDS never releases the memory of this many images.
IMAGE_DEPTH = 30
# A replaced subscription is kept for this time [s]: until all publishers have discovered the new
# one, and until its queued messages and its losses have been reported.
OVERLAP = 1.0
# Largest stamp that fits into a bag [ns].
_LATEST = 2**63 - 1


class _Topic:
    """State of one subscribed topic."""

    def __init__(self, name: str, type_name: str, message_class: type) -> None:
        self.name = name
        self.type_name = type_name
        self.message_class = message_class
        self.subscription: Subscription | None = None
        self.publishers = -1
        self.described = False
        # Number of messages lost by each of its subscriptions so far.
        self.lost_events: list[int] = []
        self.gaps = SequenceGaps()
        self.replaced: Subscription | None = None
        self.replaced_until = 0.0
        # (source stamp, number) of the last messages, and of all messages while two subscriptions
        # receive the topic: used to drop duplicates.
        self.recent: collections.deque[tuple[int, int]] = collections.deque(maxlen=64)
        self.repeated: set[tuple[int, int]] | None = None

    @property
    def lost(self) -> int:
        """Number of lost messages, by DDS events or by gaps in the sequence numbers."""
        return max(sum(self.lost_events), self.gaps.missing)


class GraphTopics:
    """Subscriptions to selected topics of the graph, including topics that appear later.

    Parameters
    ----------
    node : Node
        The node that subscribes.
    choice : TopicChoice
        The selected topics.
    describe : callable
        Called with a topic before its first message.
    receive : callable
        Called with every message.

    Attributes
    ----------
    refused : dict of str to str
        Reasons why topics are not recorded, by topic.
    """

    def __init__(
        self,
        node: Node,
        choice: TopicChoice,
        describe: Callable[[BagTopic], None],
        receive: Callable[[Received], None],
    ) -> None:
        self._node = node
        self._choice = choice
        self._on_topic = describe
        self._receive = receive
        self._topics: dict[str, _Topic] = {}
        self.refused: dict[str, str] = {}

    def __len__(self) -> int:
        """Return the number of subscribed topics."""
        return len(self._topics)

    @property
    def lost(self) -> dict[str, int]:
        """Number of lost messages by topic."""
        return {name: topic.lost for name, topic in self._topics.items() if topic.lost}

    def poll(self) -> None:
        """Subscribe to new topics of the graph, within the time limit."""
        for topic in self._topics.values():
            if topic.replaced is not None and time.monotonic() > topic.replaced_until:
                self._drop_replaced(topic)
        until = time.monotonic() + GRAPH_TIME
        for name, types in self._node.get_topic_names_and_types():
            # Queued messages take precedence; the next poll handles the rest.
            if time.monotonic() > until:
                return
            if name not in self._choice or name in self.refused:
                continue
            # Names and types come from other participants and may be invalid.
            try:
                topic = self._topics.get(name) or self._new_topic(name, types)
                self._subscribe(topic)
            except Exception as error:  # noqa: BLE001
                self._refuse(name, f"{name} is not recorded: {error}")

    def describe_all(self) -> None:
        """Describe the topics that have not received a message."""
        for topic in self._topics.values():
            if not topic.described:
                self._describe(topic)

    def unsubscribe(self) -> None:
        """Destroy all subscriptions."""
        for topic in self._topics.values():
            self._drop_replaced(topic)
            if topic.subscription is not None:
                self._node.destroy_subscription(topic.subscription)
                topic.subscription = None

    def _new_topic(self, name: str, types: list[str]) -> _Topic:
        if len(types) > 1:
            raise ValueError(f"it has several types: {', '.join(types)}")
        full_definition(types[0])
        topic = _Topic(name, types[0], message_class(types[0]))
        self._topics[name] = topic
        return topic

    def _refuse(self, name: str, why: str) -> None:
        self.refused[name] = why
        self._node.get_logger().warning(why)

    def _subscribe(self, topic: _Topic) -> None:
        publishers = self._node.count_publishers(topic.name)
        if publishers == topic.publishers:
            return
        offers = self._node.get_publishers_info_by_topic(topic.name)
        if len(offers) != publishers:
            return  # the graph is changing: try again at the next poll
        topic.publishers = publishers
        topic.gaps.reset()
        if topic.subscription is not None and not offers:
            return
        qos = strictest_request(offers, IMAGE_DEPTH if topic.type_name in IMAGE_TYPES else DEPTH)
        if not offers and self._has_best_effort_subscriber(topic.name):
            # The publisher is likely to offer best effort as well.
            qos.reliability = ReliabilityPolicy.BEST_EFFORT
        before = topic.subscription
        if before is not None:
            now = before.qos_profile
            if (now.reliability, now.durability) == (qos.reliability, qos.durability):
                return
        number = len(topic.lost_events)
        topic.lost_events.append(0)

        def count_lost(event: Any) -> None:
            topic.lost_events[number] = event.total_count

        def receive(data: bytes, info: dict[str, int]) -> None:
            self._receive_all(topic, following, data, info)

        following = self._node.create_subscription(
            topic.message_class,
            topic.name,
            receive,
            qos,
            event_callbacks=SubscriptionEventCallbacks(message_lost=count_lost),
            raw=True,
        )
        if before is not None:
            self._drop_replaced(topic)
            topic.replaced, topic.replaced_until = before, time.monotonic() + OVERLAP
            topic.repeated = {*topic.recent, *(topic.repeated or ())}
        topic.subscription = following

    def _has_best_effort_subscriber(self, name: str) -> bool:
        return any(
            info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
            for info in self._node.get_subscriptions_info_by_topic(name)
        )

    def _drop_replaced(self, topic: _Topic) -> None:
        """Receive the queued messages of a replaced subscription, and destroy it."""
        if topic.replaced is not None:
            # The new subscription receives messages that arrive in the meantime.
            depth = topic.replaced.qos_profile.depth
            for taken in islice(_queued(topic, topic.replaced), depth):
                self._receive_one(topic, *taken)
            self._node.destroy_subscription(topic.replaced)
            topic.replaced = None

    def _receive_all(
        self, topic: _Topic, source: Subscription, data: bytes, info: dict[str, int]
    ) -> None:
        """Receive a message and those queued behind it, which saves expensive executor turns."""
        self._receive_one(topic, data, info)
        until = time.monotonic() + TURN
        for taken in _queued(topic, source):
            self._receive_one(topic, *taken)
            if time.monotonic() >= until:
                return
        if topic.replaced is None:
            topic.repeated = None

    def _receive_one(self, topic: _Topic, data: bytes, info: dict[str, int]) -> None:
        sent = info["source_timestamp"]
        number = info["publication_sequence_number"] or 0
        if topic.repeated is not None:
            if (sent, number) in topic.repeated:
                return
            topic.repeated.add((sent, number))
        topic.recent.append((sent, number))
        if not topic.described:
            self._describe(topic)
        # The order is not defined while two subscriptions deliver messages.
        if number and topic.publishers == 1 and topic.replaced is None:
            topic.gaps.add(number)
        received = info["received_timestamp"] or time.time_ns()
        # The publisher may send an invalid stamp.
        sent = sent if 0 < sent <= _LATEST else received
        self._receive(Received(topic.name, data, received, sent, number))

    def _describe(self, topic: _Topic) -> None:
        topic.described = True
        offers = self._node.get_publishers_info_by_topic(topic.name)
        known = offers or self._node.get_subscriptions_info_by_topic(topic.name)
        self._on_topic(
            BagTopic(
                name=topic.name,
                type_name=topic.type_name,
                definition=full_definition(topic.type_name),
                type_hash=str(known[0].topic_type_hash) if known else "",
                offered_qos=tuple(offered_qos(offer) for offer in offers),
            )
        )


def _queued(topic: _Topic, subscription: Subscription) -> Iterator[tuple[bytes, dict[str, int]]]:
    """Yield the queued messages of a subscription."""
    handle = subscription.handle
    with handle:
        while (taken := handle.take_message(topic.message_class, True)) is not None:
            yield taken
