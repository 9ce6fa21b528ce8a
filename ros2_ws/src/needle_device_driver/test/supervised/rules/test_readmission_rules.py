"""What `device/reset` lets in again, and what not, named as in docs/safety.md."""

from __future__ import annotations

import pytest

from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.hold import LONGEST_NAME, MAX_SENDERS
from needle_device_driver.supervisor.states import State

from ..checks import in_state
from ..ideal_axes import Bench

MS = 1_000_000
FAR_AHEAD = 10**18


class Hand:
    """A sender at 20 Hz whose stamps are a clock's, off by what it is told."""

    def __init__(self, bench: Bench, sender: str = "a") -> None:
        self.bench = bench
        self.sender = sender
        self.ahead_ns = 0
        self.sent: list[tuple[bool, int]] = []

    def send(self, pressed: bool, count: int = 1) -> None:
        for _ in range(count):
            self.bench.now += 0.05
            stamp = round(self.bench.now * 1e9) + self.ahead_ns
            self.sent.append((pressed, stamp))
            self.bench.hold(pressed, sender=self.sender, stamp_ns=stamp)

    def repeat(self, messages: list[tuple[bool, int]]) -> None:
        """Send messages a second time, all at once."""
        for pressed, stamp in messages:
            self.bench.hold(pressed, sender=self.sender, stamp_ns=stamp)


def has_hold(bench: Bench, sender: str) -> bool:
    return bench.status.hold_owner == sender


@pytest.fixture
def hand(bench: Bench) -> Hand:
    """Return a hand that was ahead for a while, and whose holds are refused since."""
    bench.ready(holding=False)
    hand = Hand(bench)
    hand.ahead_ns = FAR_AHEAD
    hand.send(False, 3)
    hand.send(True, 3)
    hand.send(False, 3)
    hand.ahead_ns = 0
    hand.send(False, 3)
    hand.send(True, 3)
    assert not has_hold(bench, "a")
    assert bench.last_rule is Rule.HOLD_STAMP_INCREASES
    assert "device/reset" in bench.status.reason
    return hand


@pytest.mark.parametrize("silence", [0.0, 5.0])
@pytest.mark.parametrize("ahead_ns", [FAR_AHEAD, 3_600_000_000_000, 2_000_000_000])
def test_hold_stamp_increases_reset_lets_in_one_that_was_ahead(
    bench: Bench, ahead_ns: int, silence: float
) -> None:
    bench.ready(holding=False)
    hand = Hand(bench)
    hand.ahead_ns = ahead_ns
    hand.send(False, 3)
    hand.ahead_ns = 0
    hand.send(False, 3)
    hand.send(True, 3)
    assert not has_hold(bench, "a")
    bench.now += silence
    bench.supervisor.observe(bench.now)
    assert bench.run(bench.supervisor.reset(bench.now)).success
    hand.send(True, 5)
    assert not has_hold(bench, "a"), "pressed since before the reset"
    hand.send(False, 3)
    hand.send(True)
    assert has_hold(bench, "a")
    hand.send(True, 100)
    assert has_hold(bench, "a")


def test_hold_stamp_increases_reset_puts_the_way_out_in_reach(bench: Bench, hand: Hand) -> None:
    bench.insertion.position = 0.001
    assert bench.run(bench.supervisor.reset(bench.now)).success
    hand.send(False)
    hand.send(True)
    bench.supervisor.observe(bench.now)
    assert bench.supervisor.retract(bench.now).success
    for _ in range(50):
        bench.cycle(2)
        hand.send(True)
    assert bench.insertion.position == 0.0


@pytest.mark.parametrize("silence", [0.0, 5.0])
def test_hold_stamp_increases_nothing_from_before_a_reset_counts_again(
    bench: Bench, hand: Hand, silence: float
) -> None:
    bench.now += silence
    bench.supervisor.observe(bench.now)
    assert bench.run(bench.supervisor.reset(bench.now)).success
    before = list(hand.sent)
    for message in before:
        hand.repeat([message])
        assert not has_hold(bench, "a")
    hand.repeat(before)
    hand.repeat(before[::-1])
    assert not has_hold(bench, "a")
    hand.send(False, 3)
    for message in before:
        hand.repeat([message])
        assert not message[0] or not has_hold(bench, "a")
    hand.send(False, 3)
    hand.send(True)
    assert has_hold(bench, "a")


@pytest.mark.parametrize("silence", [0.0, 5.0])
def test_hold_stamp_increases_a_press_that_was_on_its_way_at_a_reset(
    bench: Bench, silence: float
) -> None:
    bench.ready(holding=False)
    hand = Hand(bench)
    hand.send(False, 3)
    late = round(bench.now * 1e9) + 10 * MS
    hand.send(False)
    bench.now += silence
    bench.supervisor.observe(bench.now)
    assert bench.run(bench.supervisor.reset(bench.now)).success
    bench.hold(stamp_ns=late)
    assert not has_hold(bench, "a")


def test_hold_new_press_an_old_release_stops_but_lets_no_press_count(bench: Bench) -> None:
    bench.home()
    bench.hold(stamp_ns=50)
    bench.supervisor.enable(True, bench.now)
    bench.hold(False, stamp_ns=40)
    bench.hold(stamp_ns=60)
    assert not has_hold(bench, "a"), "it was pressed before enable and is pressed still"
    bench.hold(False, stamp_ns=70)
    bench.hold(stamp_ns=80)
    assert has_hold(bench, "a")


def test_hold_new_press_one_that_was_silent_over_a_reset(bench: Bench) -> None:
    bench.ready()
    bench.now += 1.0
    bench.supervisor.observe(bench.now)
    assert bench.run(bench.supervisor.reset(bench.now)).success
    bench.hold()
    assert not has_hold(bench, "a"), "pressed since before the reset"
    bench.hold(False)
    bench.hold()
    assert has_hold(bench, "a")


def test_hold_stamp_increases_what_counts_is_the_highest_stamp_before_a_reset(
    bench: Bench,
) -> None:
    bench.ready(holding=False)
    bench.hold(False, stamp_ns=1000)
    bench.hold(False, sender="b", stamp_ns=10)
    bench.now += 1.0
    bench.supervisor.observe(bench.now)
    assert bench.run(bench.supervisor.reset(bench.now)).success
    bench.hold(stamp_ns=500)
    assert not has_hold(bench, "a")


def test_hold_stamp_increases_a_late_release_after_a_reset_keeps_no_press_out(
    bench: Bench, hand: Hand
) -> None:
    assert bench.run(bench.supervisor.reset(bench.now)).success
    for behind_ns in (0, 40 * MS):
        hand.ahead_ns = -behind_ns
        hand.send(False)
    hand.ahead_ns = 0
    hand.send(True)
    assert has_hold(bench, "a")


def test_hold_stamp_increases_a_release_from_after_a_reset_lets_any_press_count(
    bench: Bench, hand: Hand
) -> None:
    assert bench.run(bench.supervisor.reset(bench.now)).success
    hand.send(False)
    hand.ahead_ns = 2 * FAR_AHEAD
    hand.send(False)
    hand.send(True)
    assert has_hold(bench, "a")


def test_hold_one_owner_reset_forgets_who_is_silent(bench: Bench) -> None:
    bench.ready(holding=False)
    for number in range(300):
        bench.hold(sender=str(number))
        bench.hold(False, sender=str(number))
    bench.hold(sender="late")
    assert not has_hold(bench, "late")
    assert "device/reset" in bench.status.reason
    bench.now += 1.0
    bench.supervisor.observe(bench.now)
    assert bench.run(bench.supervisor.reset(bench.now)).success
    bench.hold(False, sender="late")
    bench.hold(sender="late")
    assert has_hold(bench, "late")


def test_hold_one_owner_reset_forgets_nobody_who_is_heard(bench: Bench) -> None:
    bench.ready(holding=False)
    for number in range(MAX_SENDERS):
        bench.hold(False, sender=str(number))
    assert bench.run(bench.supervisor.reset(bench.now)).success
    bench.hold(False, sender="late")
    bench.hold(sender="late")
    assert not has_hold(bench, "late")


def test_a_reset_is_refused_while_something_moves_and_forgets_nothing(bench: Bench) -> None:
    bench.ready()
    bench.command()
    bench.cycle(3, holding=True)
    assert "under way" in bench.run(bench.supervisor.reset(bench.now)).message
    assert has_hold(bench, "a")
    bench.cycle(22, holding=True)
    assert bench.results[-1].outcome == "succeeded"


@pytest.mark.parametrize(("sooner_ns", "counts"), [(19 * MS, True), (21 * MS, False)])
def test_hold_stamp_increases_a_press_after_a_reset_was_as_long_on_its_way(
    bench: Bench, sooner_ns: int, counts: bool
) -> None:
    bench.ready(holding=False)
    hand = Hand(bench)
    hand.ahead_ns = FAR_AHEAD
    hand.send(False)
    assert bench.run(bench.supervisor.reset(bench.now)).success
    hand.ahead_ns = 0
    hand.send(False)
    hand.ahead_ns = sooner_ns
    hand.send(True)
    assert has_hold(bench, "a") is counts


def test_hold_one_owner_a_crowd_is_told_of_once(bench: Bench) -> None:
    bench.ready(holding=False)
    for number in range(300):
        bench.hold(sender=f"{number}" * 1000)
    for number in range(300):
        bench.hold(False, sender=str(number))
        bench.hold(sender=str(number))
    bench.cycle()
    assert len(bench.notices) <= MAX_SENDERS + 1
    assert max(len(notice.text) for notice in bench.notices) < 4 * LONGEST_NAME


@pytest.mark.parametrize("name", ["n" * (LONGEST_NAME + 1), "x" * 1_000_000])
def test_hold_one_owner_a_name_without_end_is_nobodys(bench: Bench, name: str) -> None:
    bench.ready(holding=False)
    bench.hold(False, sender=name)
    bench.hold(sender=name)
    assert bench.status.hold_owner == ""
    assert len(bench.status.reason) < 4 * LONGEST_NAME
    bench.hold(sender="n" * LONGEST_NAME)
    assert has_hold(bench, "n" * LONGEST_NAME)


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
