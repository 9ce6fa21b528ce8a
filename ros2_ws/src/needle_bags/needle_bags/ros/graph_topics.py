"""Every chosen topic of the graph, message by message, as it was sent."""

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
from needle_bags.recording.recording import Received
from needle_bags.ros.conversions import IMAGE_TYPES, offered_qos, strictest_request
from needle_core.files.bag_topic import BagTopic

# A look at the graph takes this long at most; what is left is looked at next time [s].
GRAPH_TIME = 0.05
# What waits on one topic is taken for this long at most: then it is the others' turn [s].
TURN = 0.02
# All that Fast DDS keeps for a reader by default: a burst while the graph is looked at must fit.
DEPTH = 5000
# A second of a camera's. Fast DDS keeps the memory of as many for good, at their largest.
IMAGE_DEPTH = 30
# A subscription that another one has replaced is listened to for so long still [s]: until that one
# is found by all publishers, and until what waits for it and what it has lost are told.
OVERLAP = 1.0
# Stamps that fit a bag: nanoseconds since the epoch, as a signed number.
_LATEST = 2**63 - 1


class _Topic:
    """One topic being listened to."""

    def __init__(self, name: str, type_name: str, message_class: type) -> None:
        self.name = name
        self.type_name = type_name
        self.message_class = message_class
        self.subscription: Subscription | None = None
        self.publishers = -1
        self.described = False
        # What each of its subscriptions, one after the other, has lost.
        self.lost_events: list[int] = []
        self.gaps = SequenceGaps()
        self.replaced: Subscription | None = None
        self.replaced_until = 0.0
        # Source stamps and numbers, which tell messages apart, of the last ones, and of all while
        # two subscriptions get them.
        self.recent: collections.deque[tuple[int, int]] = collections.deque(maxlen=64)
        self.repeated: set[tuple[int, int]] | None = None

    @property
    def lost(self) -> int:
        """Messages that did not arrive: as DDS tells, or as the numbers of the others show."""
        return max(sum(self.lost_events), self.gaps.missing)


class GraphTopics:
    """Subscriptions to the chosen topics of the graph; those that appear later included.

    Parameters
    ----------
    node : Node
        The node that subscribes.
    choice : TopicChoice
        Which topics.
    describe : callable
        Takes a topic, before its first message.
    take : callable
        Takes a message.

    Attributes
    ----------
    refused : dict of str to str
        Topic to why it is not listened to.
    """

    def __init__(
        self,
        node: Node,
        choice: TopicChoice,
        describe: Callable[[BagTopic], None],
        take: Callable[[Received], None],
    ) -> None:
        self._node = node
        self._choice = choice
        self._on_topic = describe
        self._take = take
        self._topics: dict[str, _Topic] = {}
        self.refused: dict[str, str] = {}

    def __len__(self) -> int:
        """Return how many topics are listened to."""
        return len(self._topics)

    @property
    def lost(self) -> dict[str, int]:
        """Messages that did not arrive, by topic."""
        return {name: topic.lost for name, topic in self._topics.items() if topic.lost}

    def poll(self) -> None:
        """Look at the graph, as far as there is time."""
        for topic in self._topics.values():
            if topic.replaced is not None and time.monotonic() > topic.replaced_until:
                self._leave_replaced(topic)
        until = time.monotonic() + GRAPH_TIME
        for name, types in self._node.get_topic_names_and_types():
            # What waits on the topics that are there comes first; the rest at the next poll.
            if time.monotonic() > until:
                return
            if name not in self._choice or name in self.refused:
                continue
            # Names and types are whatever another participant of the graph says.
            try:
                topic = self._topics.get(name) or self._new_topic(name, types)
                self._subscribe(topic)
            except Exception as error:  # noqa: BLE001
                self._refuse(name, f"{name} is not recorded: {error}")

    def describe_all(self) -> None:
        """Describe the topics that have had no message."""
        for topic in self._topics.values():
            if not topic.described:
                self._describe(topic)

    def leave(self) -> None:
        """Stop listening."""
        for topic in self._topics.values():
            self._leave_replaced(topic)
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
            return  # the graph is changing under us: look again at the next poll
        topic.publishers = publishers
        topic.gaps.forget()
        if topic.subscription is not None and not offers:
            return
        qos = strictest_request(offers, IMAGE_DEPTH if topic.type_name in IMAGE_TYPES else DEPTH)
        if not offers and self._is_taken_best_effort(topic.name):
            # More would be more than the publisher that is still to come is likely to offer.
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

        def take(data: bytes, info: dict[str, int]) -> None:
            if following is topic.replaced:
                self._take_one(topic, data, info)
                return
            # What the one before got before this one was there comes first.
            self._take_replaced(topic)
            self._take_all(topic, data, info)

        following = self._node.create_subscription(
            topic.message_class,
            topic.name,
            take,
            qos,
            event_callbacks=SubscriptionEventCallbacks(message_lost=count_lost),
            raw=True,
        )
        if before is not None:
            self._leave_replaced(topic)
            topic.replaced, topic.replaced_until = before, time.monotonic() + OVERLAP
            topic.repeated = {*topic.recent, *(topic.repeated or ())}
        topic.subscription = following

    def _is_taken_best_effort(self, name: str) -> bool:
        return any(
            info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
            for info in self._node.get_subscriptions_info_by_topic(name)
        )

    def _leave_replaced(self, topic: _Topic) -> None:
        """Take what waits for the subscription that another has replaced, and end it."""
        self._take_replaced(topic)
        if topic.replaced is not None:
            self._node.destroy_subscription(topic.replaced)
            topic.replaced = None

    def _take_replaced(self, topic: _Topic) -> None:
        if topic.replaced is None:
            return
        # What comes meanwhile comes to the other one, too.
        for taken in islice(_waiting(topic, topic.replaced), topic.replaced.qos_profile.depth):
            self._take_one(topic, *taken)

    def _take_all(self, topic: _Topic, data: bytes, info: dict[str, int]) -> None:
        """Take a message and those that wait behind it: a turn costs more than they."""
        self._take_one(topic, data, info)
        if topic.subscription is None:
            return
        until = time.monotonic() + TURN
        for taken in _waiting(topic, topic.subscription):
            self._take_one(topic, *taken)
            if time.monotonic() >= until:
                return
        if topic.replaced is None:
            topic.repeated = None

    def _take_one(self, topic: _Topic, data: bytes, info: dict[str, int]) -> None:
        sent = info["source_timestamp"]
        number = info["publication_sequence_number"] or 0
        if topic.repeated is not None:
            if (sent, number) in topic.repeated:
                return
            topic.repeated.add((sent, number))
        topic.recent.append((sent, number))
        if not topic.described:
            self._describe(topic)
        if number and topic.publishers == 1:
            topic.gaps.take(number)
        received = info["received_timestamp"] or time.time_ns()
        # When it was sent is what its publisher says.
        sent = sent if 0 < sent <= _LATEST else received
        self._take(Received(topic.name, data, received, sent, number))

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


def _waiting(topic: _Topic, subscription: Subscription) -> Iterator[tuple[bytes, dict[str, int]]]:
    """Take one after the other what waits for a subscription."""
    handle = subscription.handle
    with handle:
        while (taken := handle.take_message(topic.message_class, True)) is not None:
            yield taken
