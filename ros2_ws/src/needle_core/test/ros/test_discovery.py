"""Who must know whom before anything is sent."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Header

from needle_core.ros.discovery import AnsweringNodes, unrecorded

PATIENCE = 20.0


class Graph:
    """Nodes of one context; only those in `awake` are spun."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._executor = SingleThreadedExecutor(context=context)
        self._nodes: list[Node] = []

    def node(self, name: str, *, awake: bool = True) -> Node:
        node = Node(name, context=self._context)
        self._nodes.append(node)
        if awake:
            self.wake(node)
        return node

    def wake(self, node: Node) -> None:
        self._executor.add_node(node)

    def until(self, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end
            self._executor.spin_once(timeout_sec=0.02)

    def close(self) -> None:
        self._executor.shutdown()
        for node in self._nodes:
            node.destroy_node()


@pytest.fixture
def graph() -> Iterator[Graph]:
    context = Context()
    context.init()
    graph = Graph(context)
    yield graph
    graph.close()
    context.try_shutdown()


def test_what_no_recorder_hears_is_named(graph: Graph) -> None:
    rig = graph.node("rig")
    words = rig.create_publisher(Header, "words", 10)
    recorder = graph.node("recorder")
    assert unrecorded(rig, [words]) == ["recorder of /words"]

    recorder.create_subscription(Header, "words", lambda _: None, 10)
    graph.until(lambda: unrecorded(rig, [words]) == [])


def test_a_node_counts_once_it_has_answered(graph: Graph) -> None:
    listener = graph.node("listener")
    partners = AnsweringNodes(listener)
    source = graph.node("source", awake=False)
    assert not partners.all_of({"/source"})
    graph.wake(source)
    graph.until(lambda: partners.all_of({"/source"}))
    partners.close()


def test_a_question_that_is_lost_is_asked_again(graph: Graph) -> None:
    listener, source = graph.node("listener"), graph.node("source", awake=False)
    partners = AnsweringNodes(listener)
    (asked,) = [s for s in source.services if s.srv_name.endswith("/get_type_description")]

    def swallowed() -> bool:
        assert not partners.all_of({"/source"})
        with asked.handle:
            return asked.handle.service_take_request(asked.srv_type.Request)[0] is not None

    graph.until(swallowed)
    graph.wake(source)
    graph.until(lambda: partners.all_of({"/source"}))
    partners.close()
