"""Every node's parameters get into the bag, also where an answer is lost."""

from __future__ import annotations

import time
from typing import Any

import pytest
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from needle_bringup.parameters import ParameterSnapshots


def test_a_lost_answer_is_asked_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    context = Context()
    context.init()
    recorder, other = Node("recorder", context=context), Node("other", context=context)
    other.declare_parameter("gain", 2.5)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(recorder)
    executor.add_node(other)
    taken: dict[str, dict[str, Any]] = {}
    snapshots = ParameterSnapshots(recorder, lambda node, values: taken.update({node: values}))
    lost: list[str] = []
    take = ParameterSnapshots._ask_values

    def lose_the_first(self: ParameterSnapshots, node: str, answer: Any) -> None:
        if not lost:
            lost.append(node)
        else:
            take(self, node, answer)

    monkeypatch.setattr(ParameterSnapshots, "_ask_values", lose_the_first)
    end = time.monotonic() + 20.0
    while "/other" not in taken:
        assert time.monotonic() < end
        snapshots.poll()
        executor.spin_once(timeout_sec=0.02)
    assert lost == ["/other"]
    assert taken["/other"]["gain"] == 2.5
    executor.shutdown()
    for node in (recorder, other):
        node.destroy_node()
    context.try_shutdown()
