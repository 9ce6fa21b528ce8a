"""A run that did not reach its depth says why: what came first, not what followed from it."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Callable
from pathlib import Path

import pytest

from needle_analysis.run.run_summary import stop_cause, summarize
from needle_bags.reading.bag_reader import HealthEvent, Run, Status, read_run
from needle_bringup.simulated_operator.progress import Progress
from needle_bringup.simulation.simulate import describe


@pytest.fixture
def stopped(make_run: Callable[..., Path]) -> Run:
    """Return a run that was steered to 30 mm and then waited for a tip."""
    run = read_run(make_run(steps=30, done=False))
    last = run.controller_status[-1]
    off = Status(last.log_time + 20, {**last.values, "state": "IDLE", "reason": "device is off"})
    return dataclasses.replace(run, controller_status=[*run.controller_status, off])


def test_the_first_cause_is_kept(stopped: Run) -> None:
    assert stop_cause(stopped) == "no tip for 2 s"
    summary = summarize(stopped)
    assert (summary["converged"], summary["reached_depth"]) == (False, False)
    said = describe(summary, Path("bags/run")).splitlines()
    assert said[0] == "NOT FINISHED: stopped at 30.0 mm: no tip for 2 s"
    assert said[1].startswith("  r1 there ")


def test_a_tip_that_is_found_again_was_no_cause(stopped: Run) -> None:
    *before, waits, ends = stopped.controller_status
    again = dataclasses.replace(before[-1], log_time=waits.log_time + 5)
    run = dataclasses.replace(stopped, controller_status=[*before, waits, again, ends])
    assert stop_cause(run) == "device is off"


def test_a_device_or_a_simulation_that_stopped_first_is_the_cause(stopped: Run) -> None:
    waits = stopped.controller_status[-2].log_time
    fault = Status(waits - 3, {"state": "FAULT", "fault": "no reply", "reason": "x"})
    run = dataclasses.replace(stopped, device_status=[*stopped.device_status, fault])
    assert stop_cause(run) == "no reply"
    health = HealthEvent(waits - 5, "sim_rig: simulation", 2, "the tip left the phantom")
    run = dataclasses.replace(run, health=[*run.health, health])
    assert stop_cause(run) == "the tip left the phantom"


def test_a_wait_is_said_once_each_time() -> None:
    stream = io.StringIO()
    progress = Progress(stream)
    for reason in ("", "no tip", "no tip", "", "no tip"):
        progress.tell_wait(reason)
    progress.close("")
    assert stream.getvalue() == "waiting: no tip\nwaiting: no tip\n"
