"""What the watch lets pass, and what it does not."""

from __future__ import annotations

from needle_verification.soak.invariants import WATCHDOG_BOUND, Bounds, Watch

BOUNDS = Bounds(0.2, 0.005, 63.0, 3.14)


def moves_after_homing_for(time: float) -> set[str]:
    """Return what a motion at 1 mm/s violates that outlives a homing by so much [s]."""
    watch = Watch(BOUNDS)
    for tick in range(1000):
        at = tick * 0.005
        # After that it says nothing of what would be expected of its status.
        homing = {"state": "MOVING", "activity": "homing"}
        watch.see_device(at, homing if at < 1.0 else {"state": "FAULT", "fault": "a fault"})
        watch.see_motors(at, 0.01 - 0.001 * min(at, 1.0 + time), 0.0)
    return {violation.invariant for violation in watch.violations}


def test_what_a_homing_leaves_under_way_ends_by_the_drives_watchdog() -> None:
    assert moves_after_homing_for(WATCHDOG_BOUND - 0.02) == set()
    assert moves_after_homing_for(WATCHDOG_BOUND + 0.02) == {"no_motion_without_hold"}
