"""The executor that keeps its wait list does what rclpy's own does, and asks no entity twice."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from needle_core.ros import wait_list
from needle_core.ros.base_node import STEADY_CLOCK
from needle_core.ros.conversions import RELIABLE
from needle_core.ros.wait_list import WaitListExecutor
from own_context import own_context

LIMIT = 20.0


class Bench:
    """Two nodes, of which one is run by the executor under test."""

    def __init__(self, context: Any, make: Callable[..., SingleThreadedExecutor]) -> None:
        self.node = Node("under_test", context=context)
        self.other = Node("other", context=context)
        self.executor = make(context=context)
        self.executor.add_node(self.node)
        self.done: list[str] = []

    def until(self, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < end, self.done
            self.executor.spin_once(timeout_sec=0.01)

    def note(self, text: str) -> Callable[..., None]:
        return lambda *_: self.done.append(text)

    def sender(self, topic: str) -> Any:
        publisher = self.other.create_publisher(Header, topic, RELIABLE)
        self.until(lambda: publisher.get_subscription_count() > 0)
        return publisher

    def hear(self, topic: str, callback: Callable[..., None]) -> Any:
        return self.node.create_subscription(Header, topic, callback, RELIABLE)

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        self.other.destroy_node()


@pytest.fixture(params=[SingleThreadedExecutor, WaitListExecutor])
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    with own_context() as context:
        bench = Bench(context, request.param)
        yield bench
        bench.close()


def test_what_is_ready_together_has_its_turn_by_kind_and_age(bench: Bench) -> None:
    for topic in ("second", "first"):
        bench.hear(topic, bench.note(topic))
    senders = [bench.sender(topic) for topic in ("first", "second")]
    bench.node.create_guard_condition(bench.note("bell")).trigger()
    timer = bench.node.create_timer(1e-6, bench.note("timer"), clock=STEADY_CLOCK)
    for sender in senders:
        sender.publish(Header())
    while not timer.is_ready():
        pass
    # Within a process a message has arrived when it is sent: one look finds all.
    bench.executor.spin_once(timeout_sec=1.0)
    timer.cancel()
    bench.until(lambda: "bell" in bench.done)
    assert bench.done == ["timer", "second", "first", "bell"]


def test_entities_that_come_and_go_while_it_waits_are_known(bench: Bench) -> None:
    bench.hear("early", bench.note("early"))
    early = bench.sender("early")
    early.publish(Header())
    bench.until(lambda: bench.done == ["early"])
    # From a callback, of which one ends another that is ready with it.
    doomed = bench.hear("doomed", bench.note("doomed"))
    to_doomed = bench.sender("doomed")

    def change() -> None:
        bench.node.destroy_subscription(doomed)
        bench.hear("late", bench.note("late"))
        timer.cancel()

    timer = bench.node.create_timer(1e-6, change, clock=STEADY_CLOCK)
    to_doomed.publish(Header())
    late = bench.sender("late")
    late.publish(Header())
    bench.until(lambda: "late" in bench.done)
    early.publish(Header())
    bench.until(lambda: bench.done.count("early") == 2)
    assert "doomed" not in bench.done


def test_a_timer_that_a_callback_cancels_does_not_run(bench: Bench) -> None:
    timers: list[Any] = []

    def cancel(name: str) -> Callable[[], None]:
        def run() -> None:
            bench.done.append(name)
            for timer in timers:
                timer.cancel()

        return run

    timers += [
        bench.node.create_timer(1e-6, cancel(name), clock=STEADY_CLOCK) for name in ("one", "two")
    ]
    bench.until(lambda: bool(bench.done))
    # The rest of the same look.
    bench.executor.spin_once(timeout_sec=0.01)
    assert len(bench.done) == 1


def test_another_thread_wakes_it(bench: Bench) -> None:
    bell = bench.node.create_guard_condition(bench.note("bell"))
    # Whether it waits already or not.
    thread = threading.Thread(target=bell.trigger)
    thread.start()
    end = time.monotonic() + LIMIT
    while not bench.done:
        assert time.monotonic() < end
        bench.executor.spin_once()
    thread.join()
    assert bench.done == ["bell"]


def test_answers_of_services_reach_who_waits_for_them(bench: Bench) -> None:
    def answer(_: Any, response: Any) -> Any:
        response.success = True
        return response

    bench.node.create_service(Trigger, "do", answer)
    client = bench.node.create_client(Trigger, "do")
    bench.until(client.service_is_ready)
    future = client.call_async(Trigger.Request())
    future.add_done_callback(lambda _: bench.done.append("told"))
    bench.until(lambda: bench.done == ["told"])
    assert future.result().success
    again = client.call_async(Trigger.Request())
    bench.executor.spin_until_future_complete(again, LIMIT)
    assert again.done()


def test_a_failure_of_a_callback_is_raised(bench: Bench) -> None:
    def fail(_: Header) -> None:
        raise ValueError("no")

    bench.hear("topic", fail)
    bench.sender("topic").publish(Header())
    with pytest.raises(ValueError, match="no"):
        bench.until(lambda: False)
    # And it goes on.
    bench.node.create_guard_condition(bench.note("bell")).trigger()
    bench.until(lambda: bench.done == ["bell"])


def test_a_look_without_waiting_ends(bench: Bench) -> None:
    for _ in range(3):
        bench.executor.spin_once(timeout_sec=0.0)


@pytest.fixture
def waiting() -> Iterator[Bench]:
    with own_context() as context:
        bench = Bench(context, WaitListExecutor)
        yield bench
        bench.close()


def test_entities_are_gathered_once_however_many_callbacks_run(
    waiting: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    gathered = waits = 0
    gather, wait = wait_list._WaitList.__init__, wait_list._WaitList.wait

    def count(self: Any, executor: WaitListExecutor) -> None:
        nonlocal gathered
        gathered += 1
        gather(self, executor)

    def count_waits(self: Any, timeout_ns: int) -> Any:
        nonlocal waits
        waits += 1
        return wait(self, timeout_ns)

    heard: list[Header] = []
    waiting.hear("topic", heard.append)
    sender = waiting.sender("topic")
    waiting.executor.spin_once(timeout_sec=0.0)
    monkeypatch.setattr(wait_list._WaitList, "__init__", count)
    monkeypatch.setattr(wait_list._WaitList, "wait", count_waits)
    for number in range(1, 21):
        sender.publish(Header())
        while len(heard) < number:
            waiting.executor.spin_once(timeout_sec=LIMIT)
    assert gathered == 0
    assert waits == 20
