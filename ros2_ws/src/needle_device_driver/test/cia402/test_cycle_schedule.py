"""Cycles keep their period, and are not made up for in a burst."""

from __future__ import annotations

import numpy as np
import pytest

from needle_device_driver.cia402.cycle_clock import CycleSchedule

PERIOD, SLACK = 0.02, 0.002


def begins(lateness: list[float]) -> list[float]:
    """Return when cycles begin whose callbacks come so much after they are due [s]."""
    schedule, now, times = CycleSchedule(PERIOD, SLACK), 100.0, []
    for late in lateness:
        now += late
        times.append(now)
        now += schedule.begin(now)
    return times


def test_what_waking_up_takes_does_not_add_up() -> None:
    late = np.random.default_rng(1).uniform(0.0, 0.001, 1000)
    times = begins(list(late))
    assert times[-1] - times[0] == pytest.approx(999 * PERIOD, abs=0.001)


@pytest.mark.parametrize("held_up", [0.0021, 0.015, 0.03, 1.0])
def test_a_late_cycle_is_followed_by_no_burst(held_up: float) -> None:
    times = begins([0.0] * 5 + [held_up] + [0.0] * 5)
    gaps = np.diff(times)
    assert gaps.min() > PERIOD - SLACK - 1e-9
    assert gaps.max() == pytest.approx(PERIOD + held_up)


def test_late_cycles_are_counted() -> None:
    schedule = CycleSchedule(PERIOD, SLACK)
    for now in (0.0, 0.02, 0.041, 0.06, 0.2, 0.22, 0.25):
        schedule.begin(now)
    assert schedule.late == 2


def test_a_callback_before_its_time_begins_anew() -> None:
    schedule = CycleSchedule(PERIOD, SLACK)
    schedule.begin(0.0)
    assert schedule.begin(0.01) == pytest.approx(PERIOD)


def test_the_longest_cycle_is_told_once() -> None:
    schedule = CycleSchedule(PERIOD, SLACK)
    for now in (0.0, 0.02, 0.12, 0.14):
        schedule.begin(now)
    assert schedule.take_longest() == pytest.approx(0.1)
    assert schedule.take_longest() == 0.0
    schedule.begin(0.16)
    assert schedule.take_longest() == pytest.approx(0.02)
