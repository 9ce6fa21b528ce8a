"""Parameters of every node are recorded, even if answers are lost or late."""

from __future__ import annotations

from typing import Any

import pytest
from rcl_interfaces.msg import ParameterEvent
from rclpy.node import Node
from rclpy.parameter import Parameter

from needle_bags.ros import parameter_snapshots
from needle_bags.ros.parameter_snapshots import ParameterSnapshots

from .played_graph import PlayedGraph

OTHER, VALUES = "/rig/other", {"gain": 2.5, "names": ["a", "b"]}


class Bench(PlayedGraph):
    """Recorder, and another node that answers on demand."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__(monkeypatch, parameter_snapshots)
        self.parameters[OTHER] = VALUES
        self.taken: dict[str, dict[str, Any]] = {}
        self.snapshots = ParameterSnapshots(
            Node("recorder"), lambda node, values: self.taken.update({node: values})
        )
        self.snapshots.poll()

    def waits(self) -> None:
        """Advance time until the request is repeated."""
        self.now += parameter_snapshots.RETRY_AFTER
        self.snapshots.poll()


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(monkeypatch)


def test_a_lost_request_is_repeated_and_a_late_answer_accepted(bench: Bench) -> None:
    assert bench.taken == {"/recorder": {"own": 1}}
    names, values = bench.clients
    bench.waits()
    assert len(names.pending) == 2
    names.answer()
    names.answer()
    assert len(values.pending) == 1
    bench.waits()
    values.answer(1)
    values.answer()
    assert bench.taken[OTHER] == VALUES
    bench.snapshots.poll()
    assert bench.clients == []
    assert bench.snapshots.document()[OTHER] == {"ros__parameters": VALUES}


def test_changes_are_those_after_the_snapshot(bench: Bench) -> None:
    def event(**values: object) -> ParameterEvent:
        message = ParameterEvent(node=OTHER)
        message.stamp.sec = 2
        changes = [Parameter(name, value=value) for name, value in values.items()]
        message.changed_parameters = [change.to_parameter_msg() for change in changes]
        return message

    assert bench.snapshots.apply_event(event(gain=1.0)) == []
    bench.answer_all()
    gone = event(gain=3.5, names=["a", "b"])
    gone.deleted_parameters = [Parameter("names", value="").to_parameter_msg()]
    change = {"stamp_ns": 2_000_000_000, "node": OTHER}
    assert bench.snapshots.apply_event(gone) == [
        {**change, "name": "gain", "value": 3.5},
        {**change, "name": "names", "value": None},
    ]
    assert bench.snapshots.apply_event(event(gain=3.5)) == []
