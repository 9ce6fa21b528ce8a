"""Bounds of the limit monitor; planted bugs show what each monitor finds."""

from __future__ import annotations

import itertools
import random

import pytest

from needle_device_driver.supervisor.limits import SafetyLimits
from scenario.monitors.limit_monitor import LimitMonitor, SpeedBudget

BOUNDS = SafetyLimits()


def test_the_speed_budget_covers_all_spans() -> None:
    rng = random.Random(1)
    positions = [(0.1 * n, rng.uniform(-1.0, 1.0)) for n in range(40)]
    pace = SpeedBudget(3.0)
    for n, (at, place) in enumerate(positions):
        spans = itertools.product(positions[: n + 1], (1.0, -1.0))
        expected = max(sign * (place - at_) - 3.0 * (at - then) for (then, at_), sign in spans)
        assert pace.ahead(at, place) == pytest.approx(expected)


@pytest.mark.parametrize(("share", "count"), [(1.0, 0), (-1.0, 0), (1.02, 2), (-1.02, 2)])
def test_motors_slightly_above_their_speed_limit_are_detected(share: float, count: int) -> None:
    monitor, names = LimitMonitor(BOUNDS), set()
    for tick in range(4000):
        travel = share * tick * 0.005
        insertion, rotation = 0.12 + BOUNDS.max_speed * travel, BOUNDS.max_rotation_rate * travel
        at = monitor.observe_motors(tick * 0.005, insertion, rotation)
        names |= {text.split()[0] for text in at if "farther" in text}
    assert len(names) == count
