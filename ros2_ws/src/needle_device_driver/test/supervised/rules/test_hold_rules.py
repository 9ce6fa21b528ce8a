"""Who may let the needle move, named as in docs/safety.md."""

from __future__ import annotations

import math

import pytest

from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.states import State

from ..checks import in_state
from ..ideal_axes import Bench


def test_hold_to_run_release_stops_at_once_and_discards_the_step(bench: Bench) -> None:
    bench.ready()
    bench.command()
    bench.cycle(5, holding=True)
    at = bench.positions
    bench.hold(False)
    assert bench.results[-1].outcome == "aborted: hold released"
    bench.cycle(5)
    bench.hold()
    bench.cycle(5, holding=True)
    assert bench.positions == at
    assert in_state(bench, State.HOLDING)


def test_hold_to_run_without_hold_a_command_is_refused(bench: Bench) -> None:
    bench.ready(holding=False)
    bench.command()
    bench.cycle(3)
    assert bench.last_rule is Rule.HOLD_TO_RUN
    assert bench.positions == (0.0, 0.0)


def test_hold_age_silence_aborts_within_the_timeout_and_takes_a_new_press(bench: Bench) -> None:
    bench.ready()
    bench.command(0.002, 0.1, duration=2.0)
    started = bench.now
    while in_state(bench, State.MOVING):
        bench.cycle()
    assert bench.now - started <= bench.limits.hold_timeout + 2 * bench.period
    assert "no hold message" in bench.results[-1].outcome
    assert bench.status.watchdog_trips == 1
    bench.hold()
    assert bench.status.hold_owner == ""
    bench.hold(False)
    bench.hold()
    assert bench.status.hold_owner == "a"


def test_hold_age_a_gap_before_a_command_or_a_retraction_counts_all_the_same(bench: Bench) -> None:
    bench.ready()
    bench.insertion.position = 0.001
    bench.now += 0.3
    bench.command()
    assert bench.last_rule is Rule.HOLD_TO_RUN
    bench.hold(False)
    bench.hold()
    bench.now += 0.3
    assert "keep the hold" in bench.supervisor.retract(bench.now).message
    bench.hold(False)
    bench.hold()
    bench.now += 0.3
    bench.supervisor.observe(bench.now)
    assert bench.status.hold_owner == ""


def test_hold_age_one_that_fell_silent_pressed_keeps_no_reset_out(bench: Bench) -> None:
    bench.ready()
    bench.supervisor.fail("test")
    bench.hold()
    assert not bench.run(bench.supervisor.reset(bench.now)).success
    bench.now += 0.3
    bench.supervisor.observe(bench.now)
    assert bench.run(bench.supervisor.reset(bench.now)).success


def test_hold_age_a_message_counts_for_a_quarter_of_a_second(bench: Bench) -> None:
    bench.ready()
    bench.command(0.002, 0.1, duration=2.0)
    arrival = bench.now
    for lasts in (bench.supervisor.may_move, bench.supervisor.held):
        assert lasts(arrival + 0.249)
        assert not lasts(arrival + 0.251)
    bench.supervisor.drive(bench.period, arrival + 0.251)
    assert in_state(bench, State.HOLDING)
    assert bench.last_rule is Rule.HOLD_AGE


def test_hold_age_a_gap_that_no_cycle_saw_counts_all_the_same(bench: Bench) -> None:
    bench.ready()
    bench.command(0.002, 0.1, duration=2.0)
    bench.now += 0.3
    bench.hold()
    assert "no hold message" in bench.results[-1].outcome


def test_hold_new_press_is_asked_of_nobody_who_is_silent_or_presses_beside_the_owner(
    bench: Bench,
) -> None:
    bench.ready()
    bench.hold(sender="b")
    assert (bench.status.hold_owner, bench.status.press_again) == ("a", "")
    bench.hold(False)
    assert bench.status.press_again == "b"
    bench.now += bench.limits.hold_timeout + 0.1
    assert bench.status.press_again == ""


@pytest.mark.parametrize("press_before", ["enable", "reset", "stop"])
def test_hold_new_press_one_from_before_does_not_count(bench: Bench, press_before: str) -> None:
    bench.home()
    if press_before == "enable":
        bench.hold()
        bench.supervisor.enable(True, bench.now)
    else:
        bench.supervisor.enable(True, bench.now)
        bench.hold()
        assert bench.status.hold_owner == "a"
        if press_before == "reset":
            bench.run(bench.supervisor.reset(bench.now))
        else:
            bench.supervisor.stop()
    bench.cycle(5, holding=True)
    assert bench.status.hold_owner == ""
    assert bench.status.press_again == "a"
    assert bench.status.speed_scale == 0.0
    bench.hold(False)
    assert bench.status.press_again == ""
    bench.hold()
    assert bench.status.hold_owner == "a"
    assert bench.status.press_again == ""


@pytest.mark.parametrize("how", ["fault", "disable"])
def test_hold_new_press_a_hold_ends_with_what_it_let_move(bench: Bench, how: str) -> None:
    bench.ready()
    if how == "fault":
        bench.supervisor.fail("test")
    else:
        bench.supervisor.enable(False, bench.now)
    assert bench.status.hold_owner == ""


def test_hold_new_press_one_during_homing_does_not_count(bench: Bench) -> None:
    bench.insertion.position = 0.0005
    bench.home()
    bench.hold()
    bench.cycle(30, holding=True)
    assert bench.status.homed
    assert bench.supervisor.enable(True, bench.now).success
    bench.hold()
    assert bench.status.hold_owner == ""


def test_hold_one_owner_until_released(bench: Bench) -> None:
    bench.ready()
    bench.hold(sender="b")
    assert bench.status.hold_owner == "a"
    assert bench.last_rule is Rule.HOLD_ONE_OWNER
    bench.hold(False, sender="b")
    bench.command()
    bench.cycle(1, holding=True)
    assert in_state(bench, State.MOVING)
    bench.hold(sender="b")
    bench.hold(False)
    bench.hold(sender="b")
    assert bench.status.hold_owner == "", "b pressed while a had it: that press must not take over"
    bench.hold(False, sender="b")
    bench.hold(sender="b")
    assert bench.status.hold_owner == "b"


def test_hold_one_owner_sixteen_sources_are_known_unless_they_are_silent(bench: Bench) -> None:
    bench.ready(holding=False)
    for number in range(16):
        bench.hold(False, sender=str(number))
    bench.hold(False, sender="16")
    bench.hold(sender="16")
    assert bench.status.hold_owner == ""
    bench.now += bench.limits.hold_timeout + 0.01
    for number in range(1, 16):
        bench.hold(False, sender=str(number))
    bench.hold(False, sender="16")
    bench.hold(sender="16")
    assert bench.status.hold_owner == "16"


@pytest.mark.parametrize("scale", [math.nan, -0.1, 1.1, math.inf])
def test_speed_scale_outside_0_to_1_is_a_release(bench: Bench, scale: float) -> None:
    bench.ready()
    bench.command()
    bench.hold(scale=scale)
    assert bench.results[-1].outcome == "aborted: hold released"
    assert bench.last_rule is Rule.SPEED_SCALE


def test_speed_scale_slows_and_0_stands_still(bench: Bench) -> None:
    bench.ready(holding=False)
    assert bench.status.speed_scale == 0.0
    bench.hold(scale=0.5)
    assert bench.status.speed_scale == 0.5
    bench.command()
    bench.cycle(10, holding=True, scale=0.5)
    assert bench.insertion.position == pytest.approx(0.0002)
    bench.cycle(10, holding=True, scale=0.0)
    assert bench.insertion.position == pytest.approx(0.0002)
    assert not bench.supervisor.may_move(bench.now)
    assert not bench.supervisor.held(bench.now)


def test_no_motion_by_itself_on_configure_enable_reset(bench: Bench) -> None:
    bench.ready()
    bench.command()
    bench.cycle(3, holding=True)
    bench.insertion.fault = "stalled"
    bench.cycle(1, holding=True)
    at = bench.positions
    assert in_state(bench, State.FAULT)
    bench.insertion.orders.clear()
    bench.hold(False)
    assert bench.run(bench.supervisor.reset(bench.now)).success
    assert bench.supervisor.enable(True, bench.now).success
    bench.cycle(5)
    bench.cycle(20, holding=True)
    assert bench.positions == at
    assert "move" not in bench.insertion.orders + bench.rotation.orders[-3:]
