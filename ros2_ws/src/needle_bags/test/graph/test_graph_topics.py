"""Where one subscription replaces another nothing is lost or told twice; and what is asked for."""

from __future__ import annotations

import pytest
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Int32

from needle_bags.format.topic_choice import TopicChoice
from needle_bags.recording.recording import Received
from needle_bags.ros import graph_topics
from needle_bags.ros.graph_topics import OVERLAP, GraphTopics
from needle_core.files.bag_topic import BagTopic

from .played_graph import (
    BEST_EFFORT,
    LATCHED,
    RELIABLE,
    PlayedGraph,
    PlayedSubscription,
    sent,
)

JOINTS = "/joints"


class Graph(PlayedGraph):
    """Topics of a played graph, and the numbers that they gave."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__(monkeypatch, graph_topics)
        self.numbers: list[int] = []
        self.described: list[BagTopic] = []

        def take(message: Received) -> None:
            self.numbers.append(int(message.data))

        node = Node("recorder")
        self.topics = GraphTopics(node, TopicChoice(), self.described.append, take)

    def hear(self, subscription: PlayedSubscription, *numbers: int) -> None:
        for number in numbers:
            subscription.take(*sent(number))

    def replace(self, *heard: int) -> tuple[PlayedSubscription, PlayedSubscription]:
        """Return a subscription, which has heard some, and the one that replaces it then."""
        self.offer(JOINTS, Int32)
        self.topics.poll()
        self.hear(self.subscriptions[0], *heard)
        self.offer(JOINTS, Int32, BEST_EFFORT)
        self.topics.poll()
        before, following = self.subscriptions
        return before, following

    def asked(self) -> tuple[ReliabilityPolicy, DurabilityPolicy]:
        qos = self.subscriptions[-1].qos_profile
        return qos.reliability, qos.durability


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Graph:
    return Graph(monkeypatch)


def test_what_waits_for_the_one_before_comes_first_and_once(graph: Graph) -> None:
    before, following = graph.replace()
    graph.hear(before, 1)
    before.waiting.extend(map(sent, (2, 3, 4)))
    following.waiting.append(sent(5))
    graph.hear(following, 4)
    assert graph.numbers == [1, 2, 3, 4, 5]


def test_what_both_get_or_is_sent_again_is_given_once_whoever_is_first(graph: Graph) -> None:
    before, following = graph.replace(1, 2)
    graph.hear(following, 1, 2, 3)
    for number in range(4, 8):
        for subscription in (before, following) if number % 2 else (following, before):
            graph.hear(subscription, number)
        assert graph.numbers == list(range(1, number + 1))


def test_the_one_before_gives_what_waits_at_its_end(graph: Graph) -> None:
    before, following = graph.replace()
    graph.now += OVERLAP
    graph.topics.poll()
    graph.hear(before, 1)
    before.waiting.append(sent(2))
    assert graph.subscriptions == [before, following]
    graph.now += 0.1
    graph.topics.poll()
    assert graph.numbers == [1, 2]
    assert graph.subscriptions == [following]
    graph.hear(following, 2, 3)
    assert graph.numbers == [1, 2, 3]


def test_a_third_subscription_gives_what_the_first_two_got_first(graph: Graph) -> None:
    before, following = graph.replace()
    graph.hear(before, 1)
    graph.hear(following, 2)
    graph.offers[JOINTS].pop()
    graph.topics.poll()
    assert graph.subscriptions[0] is following
    third = graph.subscriptions[1]
    following.waiting.append(sent(3))
    graph.hear(third, 3, 4)
    graph.now += OVERLAP + 0.1
    graph.topics.poll()
    assert graph.numbers == [1, 2, 3, 4]
    assert graph.subscriptions == [third]


@pytest.mark.parametrize(
    ("offers", "reliability", "durability"),
    [
        ((RELIABLE,), ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE),
        ((LATCHED, LATCHED), ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL),
        ((LATCHED, BEST_EFFORT), ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE),
    ],
)
def test_the_strictest_that_all_publishers_can_serve_is_asked_for(
    graph: Graph,
    offers: tuple[QoSProfile, ...],
    reliability: ReliabilityPolicy,
    durability: DurabilityPolicy,
) -> None:
    for offer in offers:
        graph.offer(JOINTS, Int32, offer)
    graph.topics.poll()
    assert graph.asked() == (reliability, durability)


def test_a_topic_is_listened_to_before_it_has_a_publisher(graph: Graph) -> None:
    """Who says one thing and ends would be missed; who comes best effort is asked for no more."""
    graph.request("/estop", Int32)
    graph.topics.poll()
    assert graph.asked()[0] is ReliabilityPolicy.RELIABLE
    graph.request("/hold", Int32, BEST_EFFORT)
    graph.topics.poll()
    assert graph.asked()[0] is ReliabilityPolicy.BEST_EFFORT
    graph.offer("/hold", Int32, BEST_EFFORT)
    graph.topics.poll()
    assert len(graph.subscriptions) == 2
    graph.offer("/estop", Int32, LATCHED)
    graph.topics.poll()
    assert graph.asked()[1] is DurabilityPolicy.TRANSIENT_LOCAL


def test_what_was_lost_is_counted_for_each_topic(graph: Graph) -> None:
    graph.offer(JOINTS, Int32)
    graph.topics.poll()
    graph.hear(graph.subscriptions[0], 1, 2, 5, *range(6, 20))
    assert graph.topics.lost == {JOINTS: 2}
    graph.subscriptions[0].lost(type("Event", (), {"total_count": 7}))
    assert graph.topics.lost == {JOINTS: 7}


def test_a_topic_that_cannot_be_recorded_is_told_once_and_holds_no_other_up(graph: Graph) -> None:
    graph.types["/odd"] = "no_msgs/msg/Such"
    graph.offer(JOINTS, Int32)
    for _ in range(2):
        graph.topics.poll()
    (line,) = graph.logged
    assert "no_msgs/msg/Such is not installed" in line
    assert list(graph.topics.refused) == ["/odd"]
    graph.topics.describe_all()
    (topic,) = graph.described
    assert (topic.name, topic.type_name, len(topic.offered_qos)) == (
        JOINTS,
        "std_msgs/msg/Int32",
        1,
    )
    graph.topics.leave()
    assert graph.subscriptions == []
