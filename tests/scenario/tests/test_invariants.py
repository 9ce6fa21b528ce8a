"""What the watch lets pass, and what it does not."""

from __future__ import annotations

from needle_core.status_messages import DeviceStatus
from scenario.judging.invariants import PAGE_LIFETIME, WATCHDOG_BOUND, Watch
from scenario.judging.limit_witness import Bounds

BOUNDS = Bounds(0.2, 0.005, 63.0, 3.14, 0.0005, 0.1)


def moves_after_homing_for(time: float) -> set[str]:
    """Return what a motion at 1 mm/s violates that outlives a homing by so much [s]."""
    watch = Watch(BOUNDS)
    for tick in range(1000):
        at = tick * 0.005
        # After that it says nothing of what would be expected of its status.
        homing = DeviceStatus(state="MOVING", activity="homing")
        watch.see_device(at, homing if at < 1.0 else DeviceStatus(state="FAULT", fault="a fault"))
        watch.see_motors(at, 0.01 - 0.001 * min(at, 1.0 + time), 0.0)
    return {violation.invariant for violation in watch.violations}


def test_what_a_homing_leaves_under_way_ends_by_the_drives_watchdog() -> None:
    assert moves_after_homing_for(WATCHDOG_BOUND - 0.02) == set()
    assert moves_after_homing_for(WATCHDOG_BOUND + 0.02) == {"no_motion_without_hold"}


def page_says(held: list[tuple[float, float]], fingers: list[tuple[float, float]]) -> set[str]:
    """Return what a page's hold violates that is said in these spans, beside those of a finger."""
    watch = Watch(BOUNDS)

    def within(at: float, spans: list[tuple[float, float]]) -> bool:
        return any(begin <= at < end for begin, end in spans)

    for tick in range(600):
        at = tick * 0.005
        watch.see_hand(at, holds=within(at, fingers))
        watch.see_page_hold(at, pressed=within(at, held))
    return {violation.invariant for violation in watch.violations}


def test_a_page_holds_for_no_longer_than_an_echo_counts() -> None:
    in_time, late = 2.0 + PAGE_LIFETIME - 0.005, 2.0 + PAGE_LIFETIME + 0.02
    assert page_says([(1.0, in_time)], [(1.0, 2.0)]) == set()
    assert page_says([(1.0, late)], [(1.0, 2.0)]) == {"hold_is_of_now"}


def test_what_a_page_has_lost_does_not_come_back() -> None:
    assert page_says([(1.1, 1.5), (1.6, 2.0)], [(1.0, 2.0)]) == {"hold_is_of_now"}


def test_a_press_may_come_while_the_release_before_it_is_on_its_way() -> None:
    assert page_says([(0.5, 1.05), (1.1, 2.0)], [(0.5, 1.0), (1.02, 2.0)]) == set()
