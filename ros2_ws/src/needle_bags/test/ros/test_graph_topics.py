"""Where one subscription replaces another: nothing is lost or told twice."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from needle_bags.format.topic_choice import TopicChoice
from needle_bags.recording.recording import Received
from needle_bags.ros import graph_topics
from needle_bags.ros.graph_topics import OVERLAP, GraphTopics

Take = Callable[[bytes, dict[str, int]], None]
Taken = tuple[bytes, dict[str, int]]


def sent(number: int) -> Taken:
    info = {
        "source_timestamp": number + 1,
        "received_timestamp": number + 1,
        "publication_sequence_number": number + 1,
    }
    return str(number).encode(), info


class PlayedSubscription:
    """What waits for it is what a test has put there."""

    def __init__(self, take: Take, qos: QoSProfile) -> None:
        self.take, self.qos_profile = take, qos
        self.waiting: deque[Taken] = deque()
        self.handle = self

    def __enter__(self) -> None:
        """Nothing has to be held."""

    def __exit__(self, *_: object) -> None:
        """Nothing was held."""

    def take_message(self, _: type, __: bool) -> Taken | None:
        return self.waiting.popleft() if self.waiting else None

    def hear(self, *numbers: int) -> None:
        for number in numbers:
            self.take(*sent(number))


class PlayedNode:
    """A graph of one topic."""

    def __init__(self) -> None:
        self.offers: list[Any] = []
        self.subscriptions: list[PlayedSubscription] = []

    def offer(self, reliability: ReliabilityPolicy) -> None:
        qos = QoSProfile(depth=1, reliability=reliability)
        self.offers.append(SimpleNamespace(qos_profile=qos, topic_type_hash=""))

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        return [("/joints", ["std_msgs/msg/Int32"])]

    def count_publishers(self, _: str) -> int:
        return len(self.offers)

    def get_publishers_info_by_topic(self, _: str) -> list[Any]:
        return self.offers

    def create_subscription(
        self, _: type, __: str, take: Take, qos: QoSProfile, **___: object
    ) -> PlayedSubscription:
        self.subscriptions.append(PlayedSubscription(take, qos))
        return self.subscriptions[-1]

    def destroy_subscription(self, subscription: PlayedSubscription) -> None:
        self.subscriptions.remove(subscription)


class Graph:
    """Topics of a played graph, in a time of its own, and the numbers that they gave."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        played = SimpleNamespace(monotonic=lambda: self.now, time_ns=time.time_ns)
        monkeypatch.setattr(graph_topics, "time", played)
        self.node = PlayedNode()
        self.numbers: list[int] = []
        node = cast(Node, self.node)
        self.topics = GraphTopics(node, TopicChoice(), lambda _: None, self._take)

    def _take(self, message: Received) -> None:
        self.numbers.append(int(message.data))

    def replace(self, *heard: int) -> tuple[PlayedSubscription, PlayedSubscription]:
        """Return a subscription, which has heard some, and the one that replaces it then."""
        self.node.offer(ReliabilityPolicy.RELIABLE)
        self.topics.poll()
        self.node.subscriptions[0].hear(*heard)
        self.node.offer(ReliabilityPolicy.BEST_EFFORT)
        self.topics.poll()
        before, following = self.node.subscriptions
        return before, following


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Graph:
    return Graph(monkeypatch)


def test_what_waits_for_the_one_before_comes_first_and_once(graph: Graph) -> None:
    before, following = graph.replace()
    before.hear(0)
    before.waiting.extend(map(sent, (1, 2, 3)))
    following.waiting.append(sent(4))
    following.hear(3)
    assert graph.numbers == [0, 1, 2, 3, 4]


def test_what_was_sent_before_and_is_sent_again_is_given_once(graph: Graph) -> None:
    _, following = graph.replace(0, 1)
    following.hear(0, 1, 2)
    assert graph.numbers == [0, 1, 2]


def test_what_both_get_is_given_once_whoever_is_first(graph: Graph) -> None:
    before, following = graph.replace()
    for number in range(4):
        for subscription in (before, following) if number % 2 else (following, before):
            subscription.hear(number)
        assert graph.numbers == list(range(number + 1))


def test_the_one_before_is_listened_to_for_a_while_and_gives_what_waits_at_its_end(
    graph: Graph,
) -> None:
    before, following = graph.replace()
    graph.now += OVERLAP
    graph.topics.poll()
    before.hear(0)
    before.waiting.append(sent(1))
    assert graph.node.subscriptions == [before, following]
    graph.now += 0.1
    graph.topics.poll()
    assert graph.numbers == [0, 1]
    assert graph.node.subscriptions == [following]
    following.hear(1, 2)
    assert graph.numbers == [0, 1, 2]


def test_a_third_subscription_gives_what_the_first_two_got_first(graph: Graph) -> None:
    before, following = graph.replace()
    before.hear(0)
    following.hear(1)
    graph.node.offers.pop()
    graph.topics.poll()
    assert graph.node.subscriptions[0] is following
    third = graph.node.subscriptions[1]
    following.waiting.append(sent(2))
    third.hear(2, 3)
    graph.now += OVERLAP + 0.1
    graph.topics.poll()
    assert graph.numbers == [0, 1, 2, 3]
    assert graph.node.subscriptions == [third]
