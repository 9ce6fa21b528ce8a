"""Who may let the needle move, and which messages count, named as in docs/safety.md."""

from __future__ import annotations

import math

import pytest

from needle_core.hold_session import HoldSession

from ..ideal_axes import Bench

MS = 1_000_000


def test_hold_to_run_release_stops_at_once_and_discards_the_step() -> None:
    bench = Bench().moving()
    at, stops = bench.positions, bench.insertion.stops
    bench.hold(False)
    assert bench.outcomes == ["aborted: hold released"]
    assert bench.insertion.stops == bench.rotation.stops == stops + 1
    bench.wait(5)
    bench.hold()
    bench.go(5)
    assert bench.positions == at
    assert bench.state == "HOLDING"


def test_hold_to_run_without_hold_a_command_is_refused() -> None:
    bench = Bench().ready()
    bench.hold(False)
    bench.step()
    bench.wait(3)
    assert bench.rule == "hold_to_run"
    assert bench.positions == (0.0, 0.0)


# ---- age ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("lifetime", "lives"), [(math.inf, 0.25), (5.0, 0.25), (0.1, 0.1)])
def test_hold_age_a_message_counts_as_long_as_it_says_and_a_quarter_of_a_second(
    lifetime: float, lives: float
) -> None:
    bench = Bench().ready()
    bench.step(0.002, 0.1, 2.0)
    bench.hold(lifetime=lifetime)
    arrival = bench.now
    for lasts in (bench.supervisor.may_move, bench.supervisor.held):
        assert lasts(arrival + lives)
        assert not lasts(arrival + lives + 1e-6)
    bench.supervisor.drive(0.02, arrival + lives)
    assert bench.state == "MOVING"
    bench.supervisor.drive(0.02, arrival + lives + 0.001)
    assert (bench.state, bench.rule) == ("HOLDING", "hold_age")
    silence = f"no hold message for {lives + 0.001:.3f} s, limit {lives:g} s"
    assert bench.outcomes == [f"aborted: {silence}"]
    assert bench.status.reason == silence
    assert bench.status.watchdog_trips == 1
    bench.now = arrival + lives + 0.001
    assert [bench.hold(), bench.hold(False), bench.hold()] == ["", "", "a"]


def test_hold_age_one_that_lives_for_no_time_is_a_release() -> None:
    bench = Bench().ready()
    for lifetime in (0.0, -1.0, math.nan):
        bench.press()
        assert bench.hold(lifetime=lifetime) == ""
    assert bench.hold(lifetime=1e-9) == "a"


def test_hold_age_a_gap_that_no_cycle_saw_counts_all_the_same() -> None:
    bench = Bench().ready()
    bench.insertion.position = 0.001
    for number in range(4):
        bench.press()
        bench.now += 0.3
        if number == 0:
            bench.step()
            assert bench.rule == "hold_to_run"
        elif number == 1:
            assert "keep the hold" in bench.retract().message
        elif number == 2:
            bench.supervisor.observe(bench.now)
        else:
            bench.hold()
        assert bench.status.hold_owner == ""
        told = [notice.rule.value for notice in bench.notices if notice.rule]
        assert told.count("hold_age") == number + 1
    assert bench.status.watchdog_trips == 0, "nothing moved"


def test_hold_age_one_that_fell_silent_pressed_keeps_no_reset_out() -> None:
    bench = Bench().ready()
    bench.supervisor.fail("test")
    bench.hold()
    assert bench.reset().message == "release the hold first"
    bench.now += 0.249
    assert not bench.reset().success
    bench.now += 0.002
    bench.supervisor.observe(bench.now)
    assert bench.reset().success


# ---- new press ----------------------------------------------------------------------------------


@pytest.mark.parametrize("press_before", ["enable", "reset", "stop", "homing", "disable", "fault"])
def test_hold_new_press_one_from_before_does_not_count(press_before: str) -> None:
    bench = Bench()
    bench.insertion.position = 0.0005 * (press_before == "homing")
    bench.homed()
    bench.hold()
    bench.go(30)
    assert bench.enable().success
    if press_before not in ("enable", "homing"):
        bench.press()
        assert bench.status.hold_owner == "a"
    if press_before == "reset":
        assert bench.reset().success
    elif press_before == "stop":
        assert bench.supervisor.stop().success
    elif press_before == "disable":
        assert bench.enable(False).success
        assert bench.enable().success
    elif press_before == "fault":
        bench.supervisor.fail("test")
        assert bench.status.hold_owner == ""
        bench.hold(False)
        assert bench.reset().success
        bench.hold()
        assert bench.enable().success
    bench.go(5)
    assert (bench.status.hold_owner, bench.status.speed_scale) == ("", 0.0)
    assert bench.status.press_again == "a"
    bench.hold(False)
    assert bench.status.press_again == ""
    assert bench.hold() == "a"
    assert bench.status.press_again == ""


def test_hold_new_press_is_asked_of_nobody_who_is_silent_or_presses_beside_the_owner() -> None:
    bench = Bench().ready()
    bench.hold(sender="b")
    assert (bench.status.hold_owner, bench.status.press_again) == ("a", "")
    bench.hold(False)
    bench.now += 0.25
    assert bench.status.press_again == "b"
    bench.now += 0.001
    assert bench.status.press_again == ""


def test_hold_new_press_a_first_press_counts_only_without_a_session() -> None:
    bench = Bench().ready()
    bench.hold(False)
    assert bench.hold(sender="b", session="s") == ""
    assert bench.rule == "hold_new_press"
    assert bench.status.reason == "hold of 'b/s' does not count (hold_new_press)"
    assert bench.hold(sender="by_hand") == "by_hand"


# ---- one owner ----------------------------------------------------------------------------------


def test_hold_one_owner_until_released() -> None:
    bench = Bench().ready()
    assert bench.hold(sender="b") == "a"
    assert bench.rule == "hold_one_owner"
    bench.hold(False, sender="b")
    bench.step()
    bench.go()
    assert bench.state == "MOVING"
    bench.hold(sender="b")
    bench.hold(False)
    assert bench.hold(sender="b") == "", "b pressed while a had it: that press takes nothing over"
    bench.hold(False, sender="b")
    assert bench.hold(sender="b") == "b"


def test_hold_one_owner_sixteen_sources_are_known_unless_they_are_silent() -> None:
    bench = Bench().ready()
    bench.hold(False)
    for number in range(15):
        bench.hold(False, sender=str(number))
    bench.now += 0.25
    for number in range(15):
        bench.hold(False, sender=str(number))
    assert bench.hold(sender="late") == ""
    assert bench.rule == "hold_one_owner"
    bench.now += 0.001
    assert bench.hold(sender="late") == "late"
    # It took the place of the one that was silent longest, and of nobody else.
    bench.hold(False, sender="late")
    assert bench.hold(sender="3") == "3"


# ---- speed --------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [math.nan, -0.001, 1.001, math.inf])
def test_speed_scale_outside_0_to_1_is_a_release(scale: float) -> None:
    bench = Bench().moving()
    bench.hold(scale=scale)
    assert bench.outcomes == ["aborted: hold released"]
    assert bench.rule == "speed_scale"


def test_speed_scale_slows_and_0_stands_still() -> None:
    bench = Bench().homed()
    assert bench.enable().success
    assert bench.status.speed_scale == 0.0
    bench.hold(scale=0.5)
    assert bench.status.speed_scale == 0.5
    bench.step()
    bench.go(10, scale=0.5)
    assert bench.insertion.position == pytest.approx(0.0002)
    bench.go(10, scale=0.0)
    assert bench.insertion.position == pytest.approx(0.0002)
    assert not bench.supervisor.may_move(bench.now)
    assert not bench.supervisor.held(bench.now)
    bench.hold(False)
    assert bench.status.speed_scale == 0.0


# ---- order and sessions -------------------------------------------------------------------------


def in_session() -> Bench:
    """Return a device that moves by the third message of session `s`."""
    bench = Bench().homed()
    assert bench.enable().success
    for count, pressed in ((1, False), (2, False), (3, True)):
        bench.hold(pressed, session="s", count=count)
    bench.step(0.002, 0.1, 2.0)
    assert bench.state == "MOVING"
    return bench


def test_hold_in_order_a_press_that_comes_twice_keeps_nothing_alive_and_is_said_once() -> None:
    bench = in_session()
    for _ in range(20):
        bench.hold(session="s", count=3)
        bench.wait()
    assert bench.state == "HOLDING"
    assert bench.outcomes[-1].startswith("aborted: no hold message")
    assert bench.status.holds_ignored == 20
    rules = [notice.rule.value for notice in bench.notices if notice.rule]
    assert rules == ["hold_in_order", "hold_age"]


def test_hold_in_order_what_was_overtaken_changes_nothing() -> None:
    bench = in_session()
    bench.hold(session="s", count=5)
    bench.hold(False, session="s", count=4)
    assert bench.state == "MOVING"
    bench.hold(False, session="s", count=7)
    assert bench.outcomes == ["aborted: hold released"]
    assert [bench.hold(session="s", count=count) for count in (6, 7)] == ["", ""]
    assert bench.status.press_again == ""
    assert bench.status.holds_ignored == 3
    assert bench.hold(session="s", count=8) == "a"
    # A release that comes late lets no press count that was there before the stop.
    bench.supervisor.stop()
    bench.hold(session="s", count=10)
    bench.hold(False, session="s", count=9)
    assert bench.hold(session="s", count=11) == ""


@pytest.mark.parametrize("later", ["t", ""])
def test_hold_in_order_a_new_session_takes_the_place_of_the_one_before_for_good(later: str) -> None:
    bench = in_session()
    assert bench.hold(session=later, count=1) == ""
    assert bench.outcomes == ["aborted: hold released"]
    assert bench.rule == "hold_new_press"
    assert bench.hold(session=later, count=2) == "", "it has not sent a release"
    bench.hold(False, session=later, count=3)
    assert bench.hold(session=later, count=4) == "a"
    for count, pressed in ((4, False), (5, True), (100, False), (101, True)):
        assert bench.hold(pressed, session="s", count=count) == "a"
    assert bench.status.holds_ignored == 4
    bench.hold(False, session=later, count=5)
    bench.hold(False, session="s", count=102)
    assert bench.hold(session="s", count=103) == ""


def test_hold_in_order_sixteen_sessions_are_remembered_of_each_source() -> None:
    bench = in_session()
    for number in range(16):
        bench.hold(False, session=f"t{number}", count=1)
    bench.hold(False, session="s", count=100)
    assert bench.hold(session="s", count=101) == ""
    bench.hold(False, session="t16", count=1)
    bench.hold(False, session="s", count=102)
    assert bench.hold(session="s", count=103) == "a", "the seventeenth is forgotten"
    bench.hold(False, sender="b", session="s", count=1)
    bench.hold(False, sender="b", session="t", count=1)
    assert bench.hold(session="s", count=104) == "a", "another source's session is another one"


def test_hold_in_order_a_restarted_operator_goes_on_by_a_new_press() -> None:
    bench = in_session()
    for start in (1, 2):
        # Its clock was set back meanwhile.
        session = HoldSession("a")
        for pressed, owner in ((True, ""), (False, ""), (True, "a")):
            message = session.say(10**9 // start, pressed=pressed)
            bench.supervisor.receive_hold(message, bench.now)
            assert bench.status.hold_owner == owner


# ---- what a reset lets in again -----------------------------------------------------------------


def test_hold_in_order_a_reset_lets_in_a_source_without_session_that_was_ahead() -> None:
    bench = Bench().homed()
    assert bench.enable().success
    bench.hold(False, count=10**18)
    bench.hold(False, sender="b", session="s", count=10)
    bench.press()
    assert bench.status.hold_owner == ""
    assert bench.rule == "hold_in_order"
    assert bench.status.reason.endswith("(hold_in_order); device/reset ends this")
    assert bench.reset().success
    bench.press()
    assert bench.status.hold_owner == "a"
    bench.hold(False)
    ignored = bench.status.holds_ignored
    # But no earlier message of a session.
    bench.hold(False, sender="b", session="s", count=8)
    assert bench.hold(sender="b", session="s", count=9) == ""
    assert bench.status.holds_ignored == ignored + 2


def test_a_reset_is_refused_while_something_moves_and_ends_nothing() -> None:
    bench = Bench().ready()
    bench.step()
    bench.go(3)
    assert bench.reset().message == "a step is under way"
    assert bench.status.hold_owner == "a"
    bench.go(22)
    assert bench.outcomes == ["succeeded"]


def back_to(bench: Bench, ros_ns: int) -> None:
    bench.ros_ns = ros_ns
    bench.supervisor.note_time(ros_ns - MS, bench.now)
    bench.supervisor.note_time(ros_ns, bench.now)


@pytest.mark.parametrize("back_ns", [3_600_000_000_000, 1_000_000_000])
def test_command_newer_a_reset_lets_commands_in_after_time_went_back(back_ns: int) -> None:
    bench = Bench()
    back_to(bench, 2 * back_ns)
    bench.ready()
    bench.step()
    bench.go(30)
    back_to(bench, back_ns)
    bench.step()
    assert bench.rule == "command_newer"
    assert bench.outcomes[-1].endswith("ROS time went back, device/reset lets commands in again")
    assert bench.reset().success
    bench.go()
    bench.press()
    bench.step()
    bench.go(30)
    assert bench.outcomes[-1] == "succeeded"
    assert bench.positions == (0.002, 0.2)


def test_command_newer_no_stamp_is_used_twice_though_time_went_back() -> None:
    bench = Bench().ready()
    used = bench.step()
    bench.go(2)
    bench.supervisor.stop()
    bench.step(stamp_ns=used)
    assert "device/reset" not in bench.outcomes[-1]
    assert bench.reset().success
    bench.press()
    for older_by in (0, 1, 100 * MS):
        bench.step(stamp_ns=used - older_by)
        assert (bench.rule, bench.state) == ("command_newer", "HOLDING")
    back_to(bench, used - 200 * MS)
    assert bench.reset().success
    bench.hold(False)
    bench.go(15)
    assert bench.ros_ns > used
    bench.step(stamp_ns=used)
    assert (bench.rule, bench.state) == ("command_newer", "HOLDING")
    assert bench.outcomes[-1].endswith("is that of an earlier command")
    bench.step(stamp_ns=used + 1)
    assert bench.state == "MOVING"
