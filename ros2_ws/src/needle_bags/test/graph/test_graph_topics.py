"""Replacement of subscriptions without loss or duplicates, and the requested QoS."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from std_msgs.msg import Int32

from needle_bags.format.topic_choice import TopicChoice
from needle_bags.ros import graph_topics
from needle_bags.ros.graph_topics import OVERLAP, GraphTopics
from needle_core.files.bag_topic import BagTopic

from .played_graph import BEST_EFFORT, LATCHED, RELIABLE, PlayedGraph, PlayedSubscription, sent

JOINTS = "/joints"
ALL, SOME = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
KEPT, VOLATILE = DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE


class Graph(PlayedGraph):
    """Topics of a played graph, and the numbers received from them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__(monkeypatch, graph_topics)
        self.numbers: list[int] = []
        self.described: list[BagTopic] = []
        self.topics = GraphTopics(
            Node("recorder"),
            TopicChoice(),
            self.described.append,
            lambda message: self.numbers.append(int(message.data)),
        )

    def receive(self, subscription: PlayedSubscription, *numbers: int) -> None:
        for number in numbers:
            subscription.callback(*sent(number))

    def replace(self, *received: int) -> tuple[PlayedSubscription, PlayedSubscription]:
        """Return a subscription that has received some numbers, and its replacement."""
        self.offer(JOINTS, Int32)
        self.topics.poll()
        self.receive(self.subscriptions[0], *received)
        self.offer(JOINTS, Int32, BEST_EFFORT)
        self.topics.poll()
        before, following = self.subscriptions
        return before, following

    def asked(self) -> tuple[ReliabilityPolicy, DurabilityPolicy]:
        self.topics.poll()
        qos = self.subscriptions[-1].qos_profile
        return qos.reliability, qos.durability


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Graph:
    return Graph(monkeypatch)


def test_duplicates_of_two_subscriptions_are_dropped(graph: Graph) -> None:
    before, following = graph.replace(1, 2)
    graph.receive(following, 1, 2, 3)
    for number in range(4, 8):
        for subscription in (before, following) if number % 2 else (following, before):
            graph.receive(subscription, number)
        assert graph.numbers == list(range(1, number + 1))


def test_a_replaced_subscription_delivers_its_queue_before_its_end(graph: Graph) -> None:
    before, following = graph.replace()
    graph.now += OVERLAP
    graph.topics.poll()
    graph.receive(before, 1)
    before.waiting.append(sent(2))
    assert graph.subscriptions == [before, following]
    graph.now += 0.1
    graph.topics.poll()
    assert (graph.numbers, graph.subscriptions) == ([1, 2], [following])
    graph.receive(following, 2, 3)
    assert graph.numbers == [1, 2, 3]


def test_a_third_subscription_keeps_the_messages_of_the_first_two(graph: Graph) -> None:
    before, following = graph.replace()
    graph.receive(before, 1)
    graph.receive(following, 2)
    graph.offers[JOINTS].pop()
    graph.topics.poll()
    assert graph.subscriptions[0] is following
    third = graph.subscriptions[1]
    following.waiting.append(sent(3))
    graph.receive(third, 3, 4)
    graph.now += OVERLAP + 0.1
    graph.topics.poll()
    assert (graph.numbers, graph.subscriptions) == ([1, 2, 3, 4], [third])


def test_the_strictest_qos_of_all_publishers_is_requested(
    graph: Graph,
) -> None:
    graph.offer("/latched", Int32, LATCHED)
    assert graph.asked() == (ALL, KEPT)
    graph.offer("/latched", Int32, RELIABLE)
    assert graph.asked() == (ALL, VOLATILE)
    graph.offer("/latched", Int32, BEST_EFFORT)
    assert graph.asked() == (SOME, VOLATILE)
    # Subscribe before the first publisher, which may send once and exit: use the subscribers' QoS.
    graph.request("/estop", Int32)
    assert graph.asked()[0] is ALL
    graph.request("/hold", Int32, BEST_EFFORT)
    assert graph.asked()[0] is SOME
    before = len(graph.subscriptions)
    graph.offer("/hold", Int32, BEST_EFFORT)
    graph.topics.poll()
    assert len(graph.subscriptions) == before
    graph.offer("/estop", Int32, LATCHED)
    assert graph.asked()[1] is KEPT


def test_losses_and_unrecordable_topics_are_reported(graph: Graph) -> None:
    graph.types["/odd"] = "no_msgs/msg/Such"
    graph.offer(JOINTS, Int32)
    for _ in range(2):
        graph.topics.poll()
    (line,) = graph.logged
    assert "no_msgs/msg/Such is not installed" in line
    assert list(graph.topics.refused) == ["/odd"]
    graph.topics.describe_all()
    (topic,) = graph.described
    assert (topic.name, topic.type_name) == (JOINTS, "std_msgs/msg/Int32")
    (subscription,) = graph.subscriptions
    graph.receive(subscription, 1, 2, 5, *range(6, 20))
    assert graph.topics.lost == {JOINTS: 2}
    subscription.lost(SimpleNamespace(total_count=7))
    assert graph.topics.lost == {JOINTS: 7}
    graph.topics.unsubscribe()
    assert graph.subscriptions == []
