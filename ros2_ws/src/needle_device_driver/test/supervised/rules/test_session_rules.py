"""Which messages of a source count, named as in docs/safety.md."""

from __future__ import annotations

import pytest

from needle_core.hold_session import HoldSession
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.states import State

from ..checks import in_state
from ..ideal_axes import Bench


@pytest.fixture
def bench(bench: Bench) -> Bench:
    """Return a device whose hold belongs to the third message of session `s`, and that moves."""
    bench.ready(holding=False)
    bench.hold(False, session="s", count=1)
    bench.hold(False, session="s", count=2)
    bench.hold(session="s", count=3)
    bench.command(0.002, 0.1, duration=2.0)
    assert in_state(bench, State.MOVING)
    return bench


def test_hold_in_order_a_press_that_comes_twice_keeps_nothing_alive(bench: Bench) -> None:
    for _ in range(20):
        bench.hold(session="s", count=3)
        bench.cycle()
    assert in_state(bench, State.HOLDING)
    assert bench.results[-1].outcome.startswith("aborted: no hold message")
    assert bench.status.holds_ignored == 20
    assert bench.last_rule is Rule.HOLD_AGE


def test_hold_in_order_a_release_that_was_overtaken_changes_nothing(bench: Bench) -> None:
    bench.hold(session="s", count=5)
    bench.hold(False, session="s", count=4)
    assert in_state(bench, State.MOVING)
    bench.hold(False, session="s", count=6)
    assert bench.results[-1].outcome == "aborted: hold released"


def test_hold_in_order_a_press_that_a_release_has_overtaken_does_not_count(bench: Bench) -> None:
    bench.hold(False, session="s", count=6)
    for count in (4, 5):
        bench.hold(session="s", count=count)
    assert (bench.status.hold_owner, bench.status.press_again) == ("", "")
    assert bench.status.holds_ignored == 2
    bench.hold(session="s", count=7)
    assert bench.status.hold_owner == "a"


def test_hold_in_order_an_overtaken_release_lets_no_press_count(bench: Bench) -> None:
    bench.supervisor.stop()
    bench.hold(session="s", count=5)
    bench.hold(False, session="s", count=4)
    bench.hold(session="s", count=6)
    assert bench.status.hold_owner == "", "it was pressed before the stop and is pressed still"


def test_hold_in_order_what_is_ignored_is_said_once(bench: Bench) -> None:
    for count in range(4, 8):
        bench.hold(session="s", count=count)
        bench.hold(session="s", count=count)
    assert [notice.rule for notice in bench.notices].count(Rule.HOLD_IN_ORDER) == 1


def test_hold_in_order_a_new_session_ends_the_hold_of_the_one_before(bench: Bench) -> None:
    bench.hold(session="t", count=1)
    assert bench.results[-1].outcome == "aborted: hold released"
    assert bench.status.hold_owner == ""
    assert bench.last_rule is Rule.HOLD_NEW_PRESS
    bench.hold(session="t", count=2)
    assert bench.status.hold_owner == "", "it has not sent a release"
    bench.hold(False, session="t", count=3)
    bench.hold(session="t", count=4)
    assert bench.status.hold_owner == "a"


@pytest.mark.parametrize("later", ["t", ""])
def test_hold_in_order_a_replaced_session_counts_never_again(bench: Bench, later: str) -> None:
    bench.hold(False, session=later, count=1)
    bench.hold(session=later, count=2)
    assert bench.status.hold_owner == "a"
    for count, pressed in ((4, False), (5, True), (100, False), (101, True)):
        bench.hold(pressed, session="s", count=count)
        assert bench.status.hold_owner == "a", "it ends no hold of the session that replaced it"
    assert bench.status.holds_ignored == 4
    bench.hold(False, session=later, count=3)
    bench.hold(False, session="s", count=102)
    bench.hold(session="s", count=103)
    assert bench.status.hold_owner == ""


def test_hold_in_order_sixteen_sessions_are_remembered(bench: Bench) -> None:
    for number in range(16):
        bench.hold(False, session=f"t{number}", count=1)
    bench.hold(False, session="s", count=100)
    bench.hold(session="s", count=101)
    assert bench.status.hold_owner == ""
    bench.hold(False, session="t15", count=2)
    bench.hold(session="t15", count=3)
    assert bench.status.hold_owner == "a"


def test_hold_in_order_a_session_of_one_source_is_nothing_to_another(bench: Bench) -> None:
    bench.hold(False, sender="b", session="s", count=1)
    bench.hold(False, sender="b", session="t", count=1)
    assert in_state(bench, State.MOVING)
    bench.hold(session="s", count=4)
    assert bench.status.hold_owner == "a"
    assert bench.status.holds_ignored == 0


def test_hold_in_order_a_restarted_operator_goes_on_by_a_new_press(bench: Bench) -> None:
    for start in (1, 2):
        # Its clock was set back meanwhile.
        session = HoldSession("a")
        for pressed in (True, False, True):
            message = session.say(10**9 // start, pressed=pressed)
            bench.supervisor.receive_hold(message, bench.now)
            assert (bench.status.hold_owner == "a") == (pressed and message.count == 3)


def test_hold_new_press_a_first_press_counts_only_without_a_session(bench: Bench) -> None:
    bench.hold(False, session="s", count=4)
    bench.hold(sender="b", session="s", count=1)
    assert bench.status.hold_owner == ""
    bench.hold(sender="by_hand", session="", count=1)
    assert bench.status.hold_owner == "by_hand"
