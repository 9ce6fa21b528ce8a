"""What is known of another computer's clock, whatever the network does."""

from __future__ import annotations

import random

import pytest

from needle_common.process.clock_offset import ClockReadings, clock_offset

MS = 1_000_000


@pytest.mark.parametrize("there_ms", [0, 5, 200])
@pytest.mark.parametrize("back_ms", [0, 5, 200])
@pytest.mark.parametrize("ahead_ms", [-200, 0, 200])
def test_the_truth_is_within_whatever_the_ways_take(
    there_ms: int, back_ms: int, ahead_ms: int
) -> None:
    asked = 1_000_000 * MS
    answered = asked + (there_ms + ahead_ms) * MS
    offset = clock_offset(asked, answered, asked + (there_ms + back_ms) * MS)
    assert abs(offset.ahead - ahead_ms * 1e-3) <= offset.within + 1e-12
    assert offset.least_difference <= abs(ahead_ms) * 1e-3 + 1e-12


def test_the_narrowest_reading_counts_and_old_ones_do_not() -> None:
    readings, draw, now = ClockReadings(), random.Random(1), 0
    assert readings.best(0) is None
    for _ in range(10):
        there, back = (5 * MS + draw.randrange(50 * MS) for _ in range(2))
        readings.add(now, now + there + 200 * MS, now + there + back)
        now += 500 * MS
    best = readings.best(now)
    assert best is not None
    assert 0.005 <= best.within < 0.03
    assert abs(best.ahead - 0.2) <= best.within
    assert readings.best(now + 20_000 * MS) is None


def test_a_clock_that_was_set_back_meanwhile_tells_nothing() -> None:
    readings = ClockReadings()
    readings.add(1000 * MS, 900 * MS, 800 * MS)
    assert readings.best(800 * MS) is None
