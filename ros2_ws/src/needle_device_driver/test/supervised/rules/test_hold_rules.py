"""Rules for the hold, named as in docs/safety.md."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import pytest

from needle_device_driver.rules import Rule

from ..ideal_axes import Bench
from ..supervisor_bench import accepted, rejected

MS = 1_000_000


def send_holds(bench: Bench, words: str) -> str:
    """Send holds, `sender/session#count` and + for a press or - for a release; a, no session, next.

    Returns
    -------
    str
        Owner of the hold after each message; - for none.
    """
    owners = []
    for sender, session, count, sign in re.findall(r"(\w*)/?(\w*)#?(\d*)([+-])", words):
        number = int(count) if count else None
        owner = bench.hold(sign == "+", sender=sender or "a", session=session, count=number)
        owners.append(owner or "-")
    return " ".join(owners)


def enabled() -> Bench:
    bench = Bench().homed()
    assert bench.enable().success
    return bench


def test_hold_to_run_is_required_and_release_aborts_the_step() -> None:
    bench = enabled()
    bench.step()
    bench.wait(3)
    assert (bench.rule, bench.positions) == ("hold_to_run", (0.0, 0.0))
    bench = Bench().moving()
    at = bench.positions
    bench.hold(False)
    assert bench.outcomes == ["aborted: hold released"]
    assert bench.insertion.orders[-1] == bench.rotation.orders[-1] == "stop"
    bench.wait(5)
    bench.go(5)
    assert (bench.positions, bench.state) == (at, "HOLDING")


# ---- age ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("lifetime", "lives"), [(math.inf, 0.25), (0.1, 0.1)])
def test_hold_age_limit_and_lifetime_of_a_message(lifetime: float, lives: float) -> None:
    bench = Bench().ready()
    bench.step(0.002, 0.1, 2.0)
    bench.hold(lifetime=lifetime)
    arrival = bench.now
    assert bench.supervisor.may_move(arrival + lives)
    assert not bench.supervisor.may_move(arrival + lives + 1e-6)
    bench.supervisor.drive(0.02, arrival + lives)
    assert bench.state == "MOVING"
    bench.supervisor.drive(0.02, arrival + lives + 0.001)
    assert (bench.state, bench.rule) == ("HOLDING", "hold_age")
    silence = f"no hold message for {lives + 0.001:.3f} s, limit {lives:g} s"
    assert bench.outcomes == [f"aborted: {silence}"]
    assert bench.status.watchdog_trips == 1
    bench.now = arrival + lives + 0.001
    assert send_holds(bench, "+ - +") == "- - a"


def test_hold_age_gap_between_cycles_counts() -> None:
    bench = Bench().ready()
    bench.insertion.position = 0.001
    requests: list[Callable[[], object]] = [bench.step, bench.retract, bench.hold]
    for request in requests:
        bench.press()
        bench.now += 0.3
        request()
        assert (bench.status.hold_owner, bench.state) == ("", "HOLDING")
    assert [notice.rule for notice in bench.notices].count(Rule.HOLD_AGE) == len(requests)
    assert bench.status.watchdog_trips == 0, "nothing moved"


def test_hold_age_expired_press_does_not_block_reset() -> None:
    bench = Bench().ready()
    bench.supervisor.fail("test")
    bench.hold()
    assert bench.reset() == rejected("release the hold first")
    bench.now += 0.25
    assert not bench.reset().success
    bench.now += 0.001
    assert bench.reset().success


# ---- new press and one owner --------------------------------------------------------------------


@pytest.mark.parametrize("event", ["reset", "stop", "disable"])
def test_hold_new_press_earlier_press_does_not_count(event: str) -> None:
    bench = Bench().ready()
    if event == "disable":
        assert bench.enable(False).success
        assert bench.status.hold_owner == ""
        # Neither does a press before the axes are enabled.
        bench.press()
        assert bench.enable().success
    else:
        reply = bench.reset() if event == "reset" else bench.supervisor.stop()
        assert reply == accepted("nothing to reset" if event == "reset" else "nothing moves")
    bench.go(5)
    assert (bench.status.hold_owner, bench.status.speed_scale) == ("", 0.0)
    assert bench.status.press_again == "a"
    assert send_holds(bench, "-") == "-"
    assert bench.status.press_again == ""
    assert send_holds(bench, "+") == "a"


def test_hold_new_press_first_press_counts_only_without_session() -> None:
    bench = enabled()
    assert send_holds(bench, "b/s+") == "-"
    assert bench.rule == "hold_new_press"
    ignored = "hold of 'b/s' ignored (hold_new_press)"
    assert (bench.status.reason, bench.status.text) == (ignored, ignored)
    # A message that is typed may have no stamp.
    assert send_holds(bench, "by_hand#0+") == "by_hand"


def test_hold_one_owner_until_released() -> None:
    bench = enabled()
    assert send_holds(bench, "a+ b+") == "a a"
    assert bench.rule == "hold_one_owner"
    # A press during another source's hold never counts; a press after its own release does.
    assert send_holds(bench, "b+ a- b+ b- b+") == "a - - - b"


def test_hold_one_owner_remembers_sixteen_sources() -> None:
    bench = enabled()
    others = " ".join(f"s{number}-" for number in range(15))
    send_holds(bench, f"a- {others}")
    for seconds in (0.0, 0.25):
        bench.now += seconds
        send_holds(bench, others)
        assert send_holds(bench, "late+") == "-"
        assert bench.rule == "hold_one_owner"
    bench.now += 0.001
    # It replaces only the source that was silent longest.
    assert send_holds(bench, "late+ late- s3+") == "late - s3"


# ---- speed --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "invalid",
    [{"scale": math.nan}, {"scale": -0.001}, {"scale": 1.001}, {"lifetime": 0.0}],
    ids=str,
)
def test_speed_scale_or_lifetime_out_of_range_is_a_release(invalid: dict[str, Any]) -> None:
    bench = Bench().moving()
    bench.hold(**invalid)
    assert bench.outcomes == ["aborted: hold released"]
    assert bench.rule == "speed_scale"


def test_speed_scale_slows_and_0_stops() -> None:
    bench = Bench().ready()
    bench.step()
    for scale in (0.5, 0.0):
        bench.go(10, scale=scale)
        assert bench.insertion.position == pytest.approx(0.0002)
        assert bench.status.speed_scale == scale
    assert not bench.supervisor.may_move(bench.now)
    bench.hold(scale=0.5)
    bench.hold(False)
    assert bench.status.speed_scale == 0.0


# ---- order and sessions -------------------------------------------------------------------------


def in_session() -> Bench:
    """Return a device that moves by the third message of session `s`."""
    bench = enabled()
    assert send_holds(bench, "a/s#1- a/s#2- a/s#3+") == "- - a"
    bench.step(0.002, 0.1, 2.0)
    assert bench.state == "MOVING"
    return bench


def test_hold_in_order_repeated_press_extends_nothing() -> None:
    bench = in_session()
    for _ in range(20):
        send_holds(bench, "a/s#3+")
        bench.wait()
    assert bench.state == "HOLDING"
    assert bench.outcomes[-1].startswith("aborted: no hold message")
    assert bench.status.holds_ignored == 20
    rules = [notice.rule for notice in bench.notices if notice.rule]
    assert rules == [Rule.HOLD_IN_ORDER, Rule.HOLD_AGE]


def test_hold_in_order_overtaken_message_changes_nothing() -> None:
    bench = in_session()
    send_holds(bench, "a/s#5+ a/s#4-")
    assert bench.state == "MOVING"
    assert send_holds(bench, "a/s#7- a/s#6+ a/s#7+") == "- - -"
    assert bench.outcomes == ["aborted: hold released"]
    assert bench.status.holds_ignored == 3
    assert send_holds(bench, "a/s#8+") == "a"
    # After a late release, a press from before the stop does not count.
    bench.supervisor.stop()
    assert send_holds(bench, "a/s#10+ a/s#9- a/s#11+") == "- - -"


@pytest.mark.parametrize("later", ["t", ""])
def test_hold_in_order_new_session_ends_the_previous(later: str) -> None:
    bench = in_session()
    assert send_holds(bench, f"a/{later}#1+") == "-"
    assert bench.outcomes == ["aborted: hold released"]
    assert bench.rule == "hold_new_press"
    # The new session must release first.
    assert send_holds(bench, f"a/{later}#2+ a/{later}#3- a/{later}#4+") == "- - a"
    assert send_holds(bench, "a/s#4- a/s#5+ a/s#100- a/s#101+") == "a a a a"
    assert bench.status.holds_ignored == 4
    assert send_holds(bench, f"a/{later}#5- a/s#102- a/s#103+") == "- - -"


# ---- holds accepted after a reset ---------------------------------------------------------------


def test_hold_in_order_reset_accepts_lower_stamps_without_session() -> None:
    bench = enabled()
    send_holds(bench, f"#{10**18}- b/s#10- - +")
    assert bench.rule == "hold_in_order"
    assert bench.status.reason.endswith("(hold_in_order); call device/reset")
    assert bench.reset().success
    # Earlier messages of a session stay rejected.
    assert send_holds(bench, "- + - b/s#8- b/s#9+") == "- a - - -"
    assert bench.status.holds_ignored == 4


def back_to(bench: Bench, ros_ns: int) -> None:
    bench.ros_ns = ros_ns
    bench.supervisor.note_time(ros_ns - MS, bench.now)
    bench.supervisor.note_time(ros_ns, bench.now)


def test_command_newer_stamps_are_used_once_and_a_reset_accepts_older_ones() -> None:
    bench = Bench().ready()
    used = bench.step()
    bench.supervisor.stop()
    bench.press()
    for older_by in (0, 1):
        bench.step(stamp_ns=used - older_by)
        assert (bench.rule, bench.state) == ("command_newer", "HOLDING")
        assert "device/reset" not in bench.outcomes[-1]
    back_to(bench, used - 200 * MS)
    bench.step()
    assert bench.outcomes[-1].endswith("call device/reset to accept commands again")
    assert bench.reset().success
    bench.press()
    bench.step()
    assert bench.rule == "command_newer", "not newer than the reset"
    bench.go()
    bench.step()
    assert bench.state == "MOVING"
    bench.supervisor.stop()
    bench.press()
    bench.go(15)
    bench.step(stamp_ns=used)
    assert (bench.rule, bench.state) == ("command_newer", "HOLDING")
    assert bench.outcomes[-1].endswith("is that of an earlier command")
