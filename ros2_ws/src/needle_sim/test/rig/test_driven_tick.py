"""When a tick at level drive is over."""

from __future__ import annotations

from needle_sim.rig.driven_tick import DrivenTick


def looks_until_over(tick: DrivenTick, now: float, most: int = 10) -> int:
    for count in range(1, most + 1):
        tick.look()
        if tick.is_over(now):
            return count
    return 0


def test_is_over_when_both_have_answered_and_nothing_more_is_heard() -> None:
    tick = DrivenTick(0.5)
    tick.begin(40, 0.0)
    assert looks_until_over(tick, 0.1) == 0
    tick.driver_at(40)
    assert looks_until_over(tick, 0.1) == 0
    tick.drives_moved()
    tick.heard()
    # A status that was sent before the joints may come after them.
    assert looks_until_over(tick, 0.1) == 2
    assert tick.unanswered == 0


def test_goes_on_after_the_timeout_and_says_who_was_silent() -> None:
    tick = DrivenTick(0.5)
    tick.begin(40, 10.0)
    tick.drives_moved()
    assert not tick.is_over(10.4)
    assert tick.is_over(10.6)
    assert tick.unanswered == 1
    assert tick.silent == "the driver (joint_states)"


def test_old_answers_do_not_count_for_the_next_tick() -> None:
    tick = DrivenTick(0.5)
    tick.begin(40, 0.0)
    tick.driver_at(40)
    tick.drives_moved()
    assert looks_until_over(tick, 0.0)
    tick.begin(60, 0.1)
    assert looks_until_over(tick, 0.1) == 0
