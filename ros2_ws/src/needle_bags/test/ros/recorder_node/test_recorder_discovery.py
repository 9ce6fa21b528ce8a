"""Publishers and subscribers that come and go while the recorder runs."""

from __future__ import annotations

import signal
from itertools import count
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Int32

from needle_bags.reading.bag_order import messages_as_sent

from .recorder_process import PATIENCE, Source, end, numbers, start


def test_topics_with_subscribers_only_are_recorded_from_the_first_message(
    domain: int, source: Source, tmp_path: Path
) -> None:
    """A publisher that says one thing and ends would be missed if the recorder came after it."""
    bag = tmp_path / "bag"
    source.node.create_subscription(Int32, "estop", lambda _: None, 10)
    process = start(domain, f"bag:={bag}")
    graph = source.node
    source.wait(lambda: graph.count_subscribers("/estop") == 2, "the recorder to subscribe")
    publisher = source.publisher(Int32, "estop")
    source.wait(lambda: publisher.get_subscription_count() == 2, "the match")
    publisher.publish(Int32(data=1))
    # What is not acknowledged goes with its publisher.
    assert publisher.wait_for_all_acked(Duration(seconds=PATIENCE))
    source.node.destroy_publisher(publisher)
    source.wait(lambda: not graph.count_publishers("/estop"), "the publisher to go")
    assert end(process, signal.SIGINT)[0] == 0
    assert numbers(bag, "/estop") == [1]


def test_a_latched_publisher_is_served_although_the_topic_was_volatile_before(
    domain: int, source: Source, tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    source.node.create_subscription(Int32, "plane", lambda _: None, 10)
    process = start(domain, f"bag:={bag}")
    graph = source.node
    source.wait(lambda: graph.count_subscribers("/plane") == 2, "the recorder to subscribe")
    latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = source.publisher(Int32, "plane", latched)
    source.wait(lambda: publisher.get_subscription_count() == 2, "the match")
    publisher.publish(Int32(data=7))
    durable = DurabilityPolicy.TRANSIENT_LOCAL
    source.wait(
        lambda: (
            durable
            in [
                info.qos_profile.durability
                for info in graph.get_subscriptions_info_by_topic("/plane")
                if info.node_name == "recorder"
            ]
        ),
        "the recorder to ask for the latched message",
    )
    source.wait_matched(publisher)
    publisher.publish(Int32(data=8))
    assert end(process)[0] == 0
    assert numbers(bag, "/plane") == [7, 8]


def test_a_best_effort_publisher_that_comes_last_is_not_told_of_incompatible_requests(
    domain: int, source: Source, tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    source.node.create_subscription(Int32, "hold", lambda _: None, best_effort)
    process = start(domain, f"bag:={bag}")
    source.wait(lambda: source.node.count_subscribers("/hold") == 2, "the recorder to subscribe")
    refused: list[Any] = []
    callbacks = PublisherEventCallbacks(incompatible_qos=refused.append)
    publisher = source.node.create_publisher(Int32, "hold", best_effort, event_callbacks=callbacks)
    source.wait(lambda: publisher.get_subscription_count() == 2, "the match")

    def heard() -> bool:
        # A best effort message is lost where the recorder has not learnt of its publisher yet.
        publisher.publish(Int32(data=1))
        return b"/hold" in (bag / "bag_0.mcap").read_bytes()

    source.wait(heard, "the recorder to hear it")
    source.wait(lambda: source.node.count_subscribers("/hold") == 2, "one subscription each")
    code, _, errors = end(process)
    assert code == 0
    assert refused == []
    assert "incompatible" not in errors
    assert set(numbers(bag, "/hold")) == {1}


def test_nothing_is_lost_where_another_request_replaces_the_first(
    domain: int, source: Source, tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    process = start(domain, f"bag:={bag}")
    reliable = source.publisher(Int32, "joints")
    source.wait_matched(reliable)
    sent = count()

    def asks(reliability: ReliabilityPolicy) -> bool:
        reliable.publish(Int32(data=next(sent)))
        infos = source.node.get_subscriptions_info_by_topic("/joints")
        return [info.qos_profile.reliability for info in infos] == [reliability]

    source.wait(lambda: asks(ReliabilityPolicy.RELIABLE), "the recorder to ask for all")
    # What comes while it stands still waits for its first subscription.
    process.send_signal(signal.SIGSTOP)
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    source.publisher(Int32, "joints", best_effort)
    for _ in range(500):
        reliable.publish(Int32(data=next(sent)))
    process.send_signal(signal.SIGCONT)
    source.wait(lambda: asks(ReliabilityPolicy.BEST_EFFORT), "the recorder to ask for less")
    assert reliable.wait_for_all_acked(Duration(seconds=PATIENCE))
    assert end(process)[0] == 0
    # Of so much, some may be lost on the way and sent again: what followed it was then there first.
    kept = messages_as_sent(bag, lambda topic: topic == "/joints", lambda _: False)
    assert [int(message.data) for _, message in kept] == list(range(next(sent)))
