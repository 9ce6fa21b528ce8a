"""The whole graph, interrupted: nothing is left, and what was recorded can be read."""

import os
import signal
import sys
import time
from pathlib import Path

import pytest

from campaign.checking import SimulateRun, StartedRun, Workbench, unreadable

LIMIT = 60.0
# The first line of progress; the operator may not have heard of the step that ended at 30.0 mm.
QUARTER = r"3\d\.\d of 120\.0 mm"


def start(bag: Path, *arguments: str) -> StartedRun:
    """Start `simulate` as scripts/simulate does, without the set-up."""
    bench = Workbench([sys.executable, "-m", "needle_bringup.simulation.simulate"], bag.parent)
    return bench.start(bag.name, *arguments)


def check_nothing_left(finished: SimulateRun) -> None:
    """Fail if a process or a shared-memory port outlived the run."""
    assert finished.left_over == []
    assert finished.left_in_memory == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interrupted_while_it_steers(tmp_path: Path, number: int) -> None:
    bag = tmp_path / "bag"
    started = start(bag, "--level", "tip", "--graph")
    started.wait_until_said(QUARTER)
    os.kill(started.process.pid, number)
    finished = started.wait(LIMIT)
    assert finished.code == 130, finished.output
    check_nothing_left(finished)
    assert unreadable(bag) == ""
    assert not (bag / "summary.json").exists()


def test_interrupted_while_the_nodes_start(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    started = start(bag, "--level", "tip", "--graph")
    started.wait_until_said("ROS_DOMAIN_ID")
    os.kill(started.process.pid, signal.SIGTERM)
    finished = started.wait(LIMIT)
    assert finished.code == 130, finished.output
    check_nothing_left(finished)
    assert not bag.exists() or unreadable(bag) == ""


def test_killed_outright_its_nodes_end_too(tmp_path: Path) -> None:
    started = start(tmp_path / "bag", "--level", "tip", "--graph")
    started.wait_until_said(QUARTER)
    started.process.kill()
    started.process.wait()
    deadline = time.monotonic() + LIMIT
    while started.running():
        assert time.monotonic() < deadline, started.running()
        time.sleep(0.05)


def test_a_node_that_dies_is_named_and_ends_the_run(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    started = start(bag, "--level", "tip", "--graph")
    started.wait_until_said(QUARTER)
    (pid,) = [pid for pid, command in started.running() if "plane_controller" in command]
    os.kill(pid, signal.SIGKILL)
    finished = started.wait(LIMIT)
    assert finished.code == 2
    assert "plane_controller ended with signal SIGKILL" in finished.last_line
    check_nothing_left(finished)
    assert unreadable(bag) == ""
