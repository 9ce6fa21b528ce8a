"""What is too long is refused unread, what is short is all heard."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Bool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from needle_core.ros.bounded_subscription import LONGEST, listen
from needle_core.ros.conversions import ESTOPS_HEARD, RELIABLE
from own_context import own_context

LIMIT = 20.0


class Bench:
    """A sender and a listener whose executor turns when told."""

    def __init__(self, context: Any) -> None:
        self.sender = Node("sender", context=context)
        self.listener = Node("listener", context=context)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.listener)
        self.calls: list[list[Any]] = []
        self.refused: list[tuple[str, str, str]] = []

    def listen(self, kind: type, topic: str, qos: Any, at_once: int) -> Any:
        refuse = lambda *words: self.refused.append(words)  # noqa: E731
        listen(self.listener, kind, topic, self.calls.append, qos, refuse=refuse, at_once=at_once)
        publisher = self.sender.create_publisher(kind, topic, qos)
        self.until(lambda: publisher.get_subscription_count() > 0, "endpoints")
        return publisher

    def until(self, condition: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < end, f"timed out: {what}; {self.refused}"
            self.executor.spin_once(timeout_sec=0.01)

    def close(self) -> None:
        self.executor.shutdown()
        self.sender.destroy_node()
        self.listener.destroy_node()


@pytest.fixture
def bench() -> Iterator[Bench]:
    with own_context() as context:
        bench = Bench(context)
        yield bench
        bench.close()


def test_a_long_message_is_refused_by_its_length_and_the_next_is_heard(bench: Bench) -> None:
    publisher = bench.listen(JointTrajectory, "way", RELIABLE, 1)
    short = JointTrajectory(points=[JointTrajectoryPoint(positions=[1.0, 2.0])])
    publisher.publish(JointTrajectory(points=short.points * 10_000))
    publisher.publish(short)
    bench.until(lambda: bool(bench.calls), "the short one")
    assert bench.calls == [[short]]
    ((topic, kind, why),) = bench.refused
    assert (topic, kind) == ("way", "too long")
    assert why.endswith(f" bytes, at most {LONGEST}")


def test_a_word_among_a_flood_of_others_is_heard_in_one_call(bench: Bench) -> None:
    publisher = bench.listen(Bool, "stop", ESTOPS_HEARD, ESTOPS_HEARD.depth)
    for number in range(500):
        publisher.publish(Bool(data=number == 3))
    bench.until(lambda: sum(map(len, bench.calls)) == 500, "all")
    assert [m.data for call in bench.calls for m in call] == [n == 3 for n in range(500)]
    assert len(bench.calls) < 500


@pytest.mark.parametrize("at_once", [1, 3, 1000])
def test_an_undecodable_message_is_refused_by_its_topic_and_the_others_are_heard(
    bench: Bench, at_once: int
) -> None:
    publisher = bench.listen(Bool, "stop", ESTOPS_HEARD, at_once)
    # No encapsulation header, half of one, a header without its value.
    for undecodable in (b"", b"\x00\x01\x00", b"\x00\x01\x00\x00"):
        publisher.publish(Bool(data=True))
        publisher.publish(undecodable)
        publisher.publish(Bool(data=False))
    bench.until(lambda: sum(map(len, bench.calls)) == 6, "all that can be decoded")
    bench.until(lambda: len(bench.refused) == 3, "the refusals")
    assert [m.data for call in bench.calls for m in call] == [True, False] * 3
    assert {refused[:2] for refused in bench.refused} == {("stop", "undecodable")}
    assert bench.refused[1][2].startswith("3 bytes: ")


def test_a_flood_of_undecodable_messages_does_not_hold_a_call_up(bench: Bench) -> None:
    publisher = bench.listen(Bool, "stop", ESTOPS_HEARD, 5)
    for _ in range(20):
        publisher.publish(b"\x00\x01\x00")
    bench.executor.spin_once(timeout_sec=LIMIT)
    assert 1 <= len(bench.refused) <= 5
    bench.until(lambda: len(bench.refused) == 20, "the others")


def test_a_call_has_no_more_than_it_may(bench: Bench) -> None:
    publisher = bench.listen(Bool, "few", ESTOPS_HEARD, 3)
    for _ in range(10):
        publisher.publish(Bool())
    bench.until(lambda: sum(map(len, bench.calls)) == 10, "all")
    assert max(map(len, bench.calls)) <= 3
