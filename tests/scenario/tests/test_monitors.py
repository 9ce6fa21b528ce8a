"""Judges beside oracles of their own; what they find at all is shown by planted bugs."""

from __future__ import annotations

import itertools
import random

import pytest

from needle_core.status_messages import DeviceStatus
from needle_device_driver.supervisor.limits import SafetyLimits
from scenario.monitors.hold_monitor import HoldMonitor
from scenario.monitors.invariants import PAGE_LIFETIME, WATCHDOG_BOUND, InvariantMonitor
from scenario.monitors.limit_monitor import LimitMonitor, SpeedBudget

BOUNDS = SafetyLimits()


def test_a_pace_is_of_all_spans() -> None:
    rng = random.Random(1)
    ways = [(0.1 * n, rng.uniform(-1.0, 1.0)) for n in range(40)]
    pace = SpeedBudget(3.0)
    for n, (at, place) in enumerate(ways):
        spans = itertools.product(ways[: n + 1], (1.0, -1.0))
        wanted = max(sign * (place - at_) - 3.0 * (at - then) for (then, at_), sign in spans)
        assert pace.ahead(at, place) == pytest.approx(wanted)


@pytest.mark.parametrize(("share", "said"), [(1.0, 0), (-1.0, 0), (1.02, 2), (-1.02, 2)])
def test_motors_a_little_beyond_their_speed_are_found(share: float, said: int) -> None:
    hold_monitor, told = LimitMonitor(BOUNDS), set()
    for tick in range(4000):
        way = share * tick * 0.005
        insertion, rotation = 0.12 + BOUNDS.max_speed * way, BOUNDS.max_rotation_rate * way
        at = hold_monitor.observe_motors(tick * 0.005, insertion, rotation)
        told |= {text.split()[0] for text in at if "farther" in text}
    assert len(told) == said


def test_who_pressed_beside_the_owner_takes_nothing_over() -> None:
    hold_monitor = HoldMonitor()

    def hold(sender: str, begin: int, end: int) -> None:
        for tick in range(begin, end + 1):
            hold_monitor.receive(tick / 50, sender, pressed=True, lifetime=0.1)

    hold("one", 0, 25)
    hold_monitor.observe_owner(0.5, "one")
    hold("other", 26, 26)
    hold("one", 26, 26)
    hold_monitor.observe_owner(0.52, "one")
    hold_monitor.receive(0.54, "one", pressed=False, lifetime=0.1)
    hold_monitor.observe_owner(0.54, "")
    hold("other", 28, 50)
    assert hold_monitor.idle(1.0) == pytest.approx(0.46)
    hold_monitor.receive(1.02, "other", pressed=False, lifetime=0.1)
    hold("other", 55, 60)
    assert hold_monitor.idle(1.2) == 0.0


def test_what_a_homing_leaves_under_way_ends_by_the_drives_watchdog() -> None:
    for beyond, violated in ((-0.02, set()), (0.02, {"no_motion_without_hold"})):
        watch = InvariantMonitor(BOUNDS)
        for tick in range(400):
            at = tick * 0.005
            # After that it says nothing of what would be expected of its status.
            homing = DeviceStatus(state="MOVING", activity="homing")
            watch.observe_device(
                at, homing if at < 1.0 else DeviceStatus(state="FAULT", fault="one")
            )
            watch.observe_motors(at, 0.01 - 0.001 * min(at, 1.0 + WATCHDOG_BOUND + beyond), 0.0)
        assert {violation.invariant for violation in watch.violations} == violated


@pytest.mark.parametrize(
    ("fingers", "held", "violates"),
    [
        ([(1.0, 2.0)], [(1.0, 1.995 + PAGE_LIFETIME)], False),
        ([(1.0, 2.0)], [(1.0, 2.02 + PAGE_LIFETIME)], True),
        ([(1.0, 2.0)], [(1.1, 1.5), (1.6, 2.0)], True),
        ([(0.5, 1.0), (1.02, 2.0)], [(0.5, 1.05), (1.1, 2.0)], False),
    ],
)
def test_a_page_holds_while_an_echo_counts_and_once(
    fingers: list[tuple[float, float]], held: list[tuple[float, float]], violates: bool
) -> None:
    watch = InvariantMonitor(BOUNDS)
    for tick in range(600):
        at = tick * 0.005
        watch.observe_hand(at, holds=any(begin <= at < end for begin, end in fingers))
        watch.observe_page_hold(at, pressed=any(begin <= at < end for begin, end in held))
    assert bool(watch.violations) is violates
