"""What `device/reset` lets in again, and what not, named as in docs/safety.md."""

from __future__ import annotations

import pytest

from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.states import State

from ..checks import in_state
from ..ideal_axes import Bench

MS = 1_000_000
FAR_AHEAD = 10**18


def has_hold(bench: Bench, sender: str) -> bool:
    return bench.status.hold_owner == sender


def test_hold_in_order_reset_lets_in_a_source_without_session_that_was_ahead(
    bench: Bench,
) -> None:
    bench.ready(holding=False)
    bench.hold(False, count=FAR_AHEAD)
    for pressed in (False, True):
        bench.hold(pressed)
    assert not has_hold(bench, "a")
    assert bench.last_rule is Rule.HOLD_IN_ORDER
    assert "device/reset" in bench.status.reason
    assert bench.run(bench.supervisor.reset(bench.now)).success
    bench.hold(False)
    bench.hold()
    assert has_hold(bench, "a")


def test_hold_in_order_reset_lets_in_no_earlier_message_of_a_session(bench: Bench) -> None:
    bench.ready(holding=False)
    bench.hold(False, session="s", count=10)
    assert bench.run(bench.supervisor.reset(bench.now)).success
    bench.hold(False, session="s", count=8)
    bench.hold(session="s", count=9)
    assert not has_hold(bench, "a")
    assert bench.status.holds_ignored == 2


@pytest.mark.parametrize("silence", [0.0, 1.0])
def test_hold_new_press_is_wanted_after_a_reset(bench: Bench, silence: float) -> None:
    bench.ready()
    bench.now += silence
    bench.supervisor.observe(bench.now)
    assert bench.run(bench.supervisor.reset(bench.now)).success
    bench.hold()
    assert not has_hold(bench, "a"), "pressed since before the reset"
    bench.hold(False)
    bench.hold()
    assert has_hold(bench, "a")


def test_a_reset_is_refused_while_something_moves_and_ends_nothing(bench: Bench) -> None:
    bench.ready()
    bench.command()
    bench.cycle(3, holding=True)
    assert "under way" in bench.run(bench.supervisor.reset(bench.now)).message
    assert has_hold(bench, "a")
    bench.cycle(22, holding=True)
    assert bench.results[-1].outcome == "succeeded"


def back_to(bench: Bench, ros_ns: int) -> None:
    bench.ros_ns = ros_ns
    bench.supervisor.note_time(ros_ns - MS, bench.now)
    bench.supervisor.note_time(ros_ns, bench.now)


@pytest.mark.parametrize("hour_ns", [3_600_000_000_000, 1_000_000_000])
def test_command_newer_reset_lets_commands_in_after_time_went_back(
    bench: Bench, hour_ns: int
) -> None:
    back_to(bench, 2 * hour_ns)
    bench.ready()
    bench.command()
    bench.cycle(30, holding=True)
    back_to(bench, hour_ns)
    bench.command()
    assert bench.last_rule is Rule.COMMAND_NEWER
    assert "device/reset" in bench.results[-1].outcome
    assert bench.run(bench.supervisor.reset(bench.now)).success
    bench.cycle(1, holding=True)
    bench.hold(False)
    bench.hold()
    bench.command()
    bench.cycle(30, holding=True)
    assert bench.results[-1].outcome == "succeeded"
    assert bench.positions == (0.002, 0.2)


def test_command_newer_no_stamp_is_used_twice_though_time_went_back(bench: Bench) -> None:
    bench.ready()
    used = bench.command()
    bench.cycle(2, holding=True)
    bench.supervisor.stop()
    back_to(bench, used - 200 * MS)
    assert bench.run(bench.supervisor.reset(bench.now)).success
    bench.hold(False)
    bench.cycle(15, holding=True)
    assert bench.ros_ns > used
    at = bench.positions
    bench.command(stamp_ns=used)
    bench.cycle(5, holding=True)
    assert bench.last_rule is Rule.COMMAND_NEWER
    assert bench.positions == at
    bench.command(stamp_ns=used + 1)
    assert in_state(bench, State.MOVING)


def test_command_newer_a_reset_lets_no_earlier_command_in(bench: Bench) -> None:
    bench.ready()
    stamp = bench.command()
    bench.cycle(2, holding=True)
    bench.supervisor.stop()
    assert bench.run(bench.supervisor.reset(bench.now)).success
    bench.hold(False)
    bench.hold()
    for older_by in (0, 1, 100 * MS):
        bench.command(stamp_ns=stamp - older_by)
        assert bench.last_rule is Rule.COMMAND_NEWER
        assert in_state(bench, State.HOLDING)
