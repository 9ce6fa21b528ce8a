from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from made_up_run import copy_messages
from needle_bags.format.bag_writer import BagCopy, BagWriter
from needle_bags.reading.bag_reader import _health_events, _series, read_run
from needle_core.errors import UserError
from needle_core.files.bag_topic import BagTopic

MakeRun = Callable[..., Path]


@pytest.fixture
def two_rigs(make_run: MakeRun, tmp_path: Path) -> Path:
    """A bag of a rig without a namespace and of a shorter run of one in /bench."""
    copy = BagCopy(tmp_path / "two", "jazzy", {})
    for bag in (make_run("one", steps=30), make_run("other", namespace="/bench/", steps=20)):
        copy_messages(bag, copy)
    copy.close()
    return tmp_path / "two"


def test_two_rigs_require_a_namespace(two_rigs: Path) -> None:
    with pytest.raises(UserError, match=r"two holds 2 rigs, in /, /bench: choose one with --names"):
        read_run(two_rigs)
    with pytest.raises(UserError, match=r"two has no rig in /desk; it has rigs in /, /bench"):
        read_run(two_rigs, "/desk")
    for name in ("bench", "/bench", "/bench/"):
        run = read_run(two_rigs, name)
        assert (run.namespace, len(run.tips)) == ("/bench/", 21)
    assert len(read_run(two_rigs, "/").tips) == 31


def test_parameters_are_those_of_the_nodes_of_the_rig(make_run: MakeRun) -> None:
    run = read_run(make_run(namespace="/bench/", steps=2))
    nodes = {"/sim_rig": {"seed": 1}, "/bench/sim_rig": {"seed": 2}, "/desk/tracker": {"a": 3}}
    run = dataclasses.replace(run, parameters=nodes)
    assert run.parameter("sim_rig", "seed") == 2
    assert run.parameter("tracker", "a") == 3
    nodes["/desk/sim_rig"] = nodes.pop("/bench/sim_rig")
    assert run.parameter("sim_rig", "seed") is None


def test_health_is_that_of_the_selected_rig() -> None:
    def status(name: str) -> Any:
        return SimpleNamespace(name=name, level=1, message="not well")

    names = ("sim_rig: a", "bench/sim_rig: b", "camera/left: c")
    for namespace, kept in (
        ("/", ["sim_rig: a", "camera/left: c"]),
        ("/bench/", ["sim_rig: a", "sim_rig: b", "camera/left: c"]),
    ):
        message = SimpleNamespace(status=[status(name) for name in names])
        health = _health_events([(0, message)], namespace, ["/", "/bench/"])
        assert [event.part for event in health] == kept


def test_holds_of_two_sessions_are_stamped_by_arrival() -> None:
    # The first message of each session.
    header = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=1))
    joy = SimpleNamespace(header=header, axes=[0.5], buttons=[1])
    holds = _series("holds", [(10, joy), (20, joy)])
    assert holds.stamps.tolist() == holds.received.tolist() == [10, 20]


def test_insertion_is_interpolated(make_run: MakeRun) -> None:
    run = read_run(make_run(steps=20))
    middle = (run.joints.stamps[:-1] + run.joints.stamps[1:]) // 2
    expected = (np.arange(20) + 0.5) * 1e-3
    np.testing.assert_allclose(run.insertion_at(middle), expected, atol=1e-12)


STATUS, TIP = "diagnostic_msgs/msg/DiagnosticStatus", "geometry_msgs/msg/PointStamped"


@pytest.mark.parametrize(
    ("types", "cause"),
    [
        ((), "contains no needle run"),
        (("std_msgs/msg/String", "std_msgs/msg/String"), "is not of the rig's graph"),
        # Readable by its own definition, but not as a tip.
        ((STATUS, TIP), r"as ROS 2 Jazzy has it \(bag of humble"),
    ],
)
def test_the_cause_of_an_unreadable_run_is_named(
    tmp_path: Path, types: tuple[str, ...], cause: str
) -> None:
    bag = BagWriter(tmp_path / "bag", distribution="humble")
    for name, kind in zip(("/needle/controller_status", "/needle/tip"), types, strict=False):
        topic = bag.add_topic(BagTopic(name, kind, "float64 old\n"))
        bag.write(topic, bytes([0, 1, 0, 0]) + bytes(8), 1, 1)
    bag.close()
    with pytest.raises(UserError, match=cause):
        read_run(tmp_path / "bag")
