"""Lanes of scripts/test: who gets which file, and how long it may take."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from code_lines import ROOT
from pytest_lanes import (
    BACKGROUND_LIMIT,
    LONG_FILES,
    LaneScheduling,
    next_file,
    pytest_collection_modifyitems,
)

NODES = "ros2_ws/src/needle_bags/test/ros/test_recorder.py"
MORE_NODES = "ros2_ws/src/needle_bags/test/ros/test_player.py"
RECKONS = "ros2_ws/src/needle_tracker/test/image/test_looks.py"
MORE = "ros2_ws/src/needle_tracker/test/image/test_tip_fit.py"
FRONT = "ros2_ws/src/needle_bags/test/ros/"
LANES = 4


class Lane:
    """A worker as the scheduler knows it; it does one test when it is told to."""

    def __init__(self, name: str) -> None:
        self.gateway = SimpleNamespace(id=name)
        self.shutting_down = False
        self.given: list[int] = []
        self.done = 0

    def send_runtest_some(self, tests: list[int]) -> None:
        self.given += tests

    def shutdown(self) -> None:
        self.shutting_down = True


class Run:
    """A run of files of one to four tests each."""

    def __init__(self, with_nodes: int, that_reckon: int) -> None:
        files = [NODES.replace("recorder", f"{number}") for number in range(with_nodes)]
        files += [RECKONS.replace("looks", f"{number}") for number in range(that_reckon)]
        self.tests = [
            f"{file}::test_{n}" for at, file in enumerate(files) for n in range(at % 4 + 1)
        ]
        config = SimpleNamespace(
            getvalue=lambda _: [f"{LANES}*popen"], option=SimpleNamespace(loadscopereorder=False)
        )
        self.scheduling = LaneScheduling(cast(pytest.Config, config))
        self.lanes = [Lane(str(number)) for number in range(LANES)]
        for lane in self.lanes:
            self.scheduling.add_node(cast(Any, lane))
            self.scheduling.add_node_collection(cast(Any, lane), self.tests)
        self.scheduling.schedule()

    def in_front(self, lane: Lane) -> list[bool]:
        """Return of each test that a lane was given whether it is one in front."""
        return [self.tests[test].startswith(FRONT) for test in lane.given]

    def finish_one(self, lane: Lane) -> None:
        lane.done += 1
        self.scheduling.mark_test_complete(cast(Any, lane), lane.given[lane.done - 1])


@pytest.mark.parametrize(
    ("with_nodes", "that_reckon"), [(6, 6), (12, 0), (0, 12), (2, 20), (20, 2), (1, 0)]
)
def test_two_lanes_are_in_front_and_none_goes_back_there(with_nodes: int, that_reckon: int) -> None:
    run = Run(with_nodes, that_reckon)
    while at_work := [lane for lane in run.lanes if lane.done < len(lane.given)]:
        assert sum(run.in_front(lane)[lane.done] for lane in at_work) <= 2
        for lane in at_work:
            run.finish_one(lane)
    assert sorted(test for lane in run.lanes for test in lane.given) == list(range(len(run.tests)))
    for lane in run.lanes:
        assert run.in_front(lane) == sorted(run.in_front(lane), reverse=True)
        assert lane.shutting_down


def test_a_lane_in_the_background_stays_there_when_one_in_front_ends_early() -> None:
    run = Run(6, 12)
    crashed, _, *behind = run.lanes
    assert run.scheduling.remove_node(cast(Any, crashed)) is not None
    while at_work := [lane for lane in behind if lane.done < len(lane.given)]:
        for lane in at_work:
            run.finish_one(lane)
    assert all(lane.shutting_down for lane in behind)
    assert not any(any(run.in_front(lane)) for lane in behind)


def test_the_test_files_that_are_run_first_are_there() -> None:
    assert [name for name in LONG_FILES if not (ROOT / name).is_file()] == []


@pytest.mark.parametrize(
    ("waiting", "in_front", "next_one"),
    [
        ([NODES, RECKONS], True, NODES),
        ([RECKONS, NODES, MORE_NODES], True, NODES),
        ([NODES, RECKONS, MORE], False, RECKONS),
        ([RECKONS, MORE], True, RECKONS),
        ([NODES, MORE_NODES], False, None),
    ],
)
def test_a_lane_gets_what_it_may_run(
    waiting: list[str], in_front: bool, next_one: str | None
) -> None:
    assert next_file(waiting, in_front=in_front) == next_one


def test_who_makes_way_for_others_has_time(request: pytest.FixtureRequest) -> None:
    for file, limit in (
        ("ros2_ws/src/needle_tracker/test/calibrating/test_box_calibration.py", BACKGROUND_LIMIT),
        ("tests/test_lanes.py", 300.0),
    ):
        item = pytest.Function.from_parent(request.node.parent, name="test", callobj=lambda: None)
        item.add_marker(pytest.mark.timeout(300.0))
        placed = SimpleNamespace(nodeid=f"{file}::test", add_marker=item.add_marker)
        pytest_collection_modifyitems([cast(pytest.Item, placed)])
        marker = item.get_closest_marker("timeout")
        assert marker is not None and marker.args == (limit,)
