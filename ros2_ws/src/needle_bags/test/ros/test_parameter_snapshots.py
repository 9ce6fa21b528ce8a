"""Every node's parameters get into the bag, also where answers are lost or come late."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from needle_bags.ros import question
from needle_bags.ros.parameter_snapshots import ParameterSnapshots

PATIENCE = 20.0


class Bench:
    """A recorder that is spun, and another node that is not yet; the time is the test's."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 1000.0
        clock = SimpleNamespace(monotonic=lambda: self.now)
        monkeypatch.setattr(question, "time", clock)
        self._context = Context()
        self._context.init()
        self.recorder = Node("recorder", context=self._context)
        self.other = Node("other", context=self._context)
        self.other.declare_parameter("gain", 2.5)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.recorder)
        self.taken: dict[str, dict[str, Any]] = {}
        self.snapshots = ParameterSnapshots(
            self.recorder, lambda node, values: self.taken.update({node: values})
        )

    def wake(self) -> None:
        self._executor.add_node(self.other)

    def swallow(self, service: str) -> bool:
        """Take a request from the other node's service, so that it is never answered."""
        (found,) = [s for s in self.other.services if s.srv_name.endswith(service)]
        with found.handle:
            return found.handle.service_take_request(found.srv_type.Request)[0] is not None

    def until(self, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end
            self.snapshots.poll()
            self._executor.spin_once(timeout_sec=0.02)

    def close(self) -> None:
        self._executor.shutdown()
        for node in (self.recorder, self.other):
            node.destroy_node()
        self._context.try_shutdown()


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    bench = Bench(monkeypatch)
    yield bench
    bench.close()


def test_a_request_that_is_lost_is_sent_again(bench: Bench) -> None:
    bench.until(lambda: bench.swallow("/list_parameters"))
    bench.wake()
    bench.now += question.ASK_AGAIN
    bench.until(lambda: "/other" in bench.taken)
    assert bench.taken["/other"]["gain"] == 2.5


def test_a_node_that_is_long_in_answering_is_never_given_up(bench: Bench) -> None:
    bench.until(lambda: bench.swallow("/list_parameters"))
    for _ in range(3 * question.MOST_PENDING):
        bench.now += 4.0
        bench.snapshots.poll()
    # What the last minutes asked is not all kept.
    waiting = [len(client._pending_requests) for client in bench.recorder.clients]
    assert max(waiting) == question.MOST_PENDING
    bench.wake()
    bench.until(lambda: "/other" in bench.taken)
    bench.until(lambda: not list(bench.recorder.clients))


def test_a_late_answer_counts(bench: Bench) -> None:
    bench.until(lambda: any(client._pending_requests for client in bench.recorder.clients))
    bench.now += question.ASK_AGAIN
    bench.snapshots.poll()
    # From here on nothing is asked again: the time stands.
    bench.wake()
    bench.until(lambda: "/other" in bench.taken)


def test_a_node_that_has_gone_is_asked_no_more(bench: Bench) -> None:
    bench.until(lambda: bench.swallow("/list_parameters"))
    bench.other.destroy_node()
    bench.until(lambda: not list(bench.recorder.clients))
