"""How fast cycles follow each other, whatever /clock says."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import pytest

from needle_device_driver.cia402.cycle_clock import CycleClock

PERIOD_NS = 20_000_000
PERIOD = 0.02
START_NS = 1_000_000_000
# Steady time is looked at so often [s].
LOOK = 0.001


def cycles(
    told: Iterable[tuple[float, int]], duration: float, *, lock_step: bool = False
) -> list[tuple[float, int]]:
    """Return (steady time, simulated time) of each cycle while `told` is heard."""
    clock = CycleClock(PERIOD_NS, lock_step=lock_step)
    waiting = iter(told)
    at, time_ns = next(waiting)
    seen = []
    for look in range(round(duration / LOOK)):
        now = look * LOOK
        while at <= now:
            clock.tell(time_ns)
            due = clock.take(now)
            if due is not None:
                seen.append((now, due))
            at, time_ns = next(waiting)
        due = clock.take(now)
        if due is not None:
            seen.append((now, due))
    return seen


def ticking(factor: float, tick: float = PERIOD) -> Iterable[tuple[float, int]]:
    """Yield what a simulation tells that is `factor` times as fast as steady time."""
    return ((k * tick / factor, START_NS + round(k * tick * 1e9)) for k in itertools.count())


@pytest.mark.parametrize("factor", [1.0, 1.05, 2.0, 4.0, 100.0])
@pytest.mark.parametrize("tick", [PERIOD, 0.001, 0.1])
def test_no_clock_makes_cycles_faster_than_steady_time(factor: float, tick: float) -> None:
    seen = cycles(ticking(factor, tick), 2.0)
    for (first, _), (last, _) in itertools.combinations(seen, 2):
        between = sum(first <= at < last for at, _ in seen)
        assert between * PERIOD <= last - first + 0.1 * PERIOD + LOOK


def test_no_cycle_is_made_up_for_after_a_pause() -> None:
    paused = ((at + (1.0 if at > 0.1 else 0.0), time_ns) for at, time_ns in ticking(4.0))
    seen = [at for at, _ in cycles(paused, 2.0) if at > 1.05]
    assert len(seen) * PERIOD <= 2.0 - 1.1 + 2 * PERIOD


def test_two_clocks_apart_are_no_faster_either() -> None:
    both = ((at, time_ns + ahead) for at, time_ns in ticking(1.0) for ahead in (0, 1_000_000_000))
    assert len(cycles(both, 2.0)) <= 2.0 / PERIOD + 1


@pytest.mark.parametrize("factor", [0.1, 0.5, 1.0])
def test_a_clock_that_is_no_faster_has_a_cycle_for_every_tick(factor: float) -> None:
    seen = cycles(ticking(factor), 2.0)
    assert [time_ns for _, time_ns in seen] == [START_NS + k * PERIOD_NS for k in range(len(seen))]
    assert len(seen) >= 2.0 * factor / PERIOD - 1


def test_in_lock_step_simulated_time_leads_alone() -> None:
    seen = cycles(ticking(100.0), 1.0, lock_step=True)
    assert len(seen) >= 100.0 / PERIOD - 10


def test_time_that_is_repeated_has_no_cycle_and_one_that_is_set_back_has() -> None:
    clock = CycleClock(PERIOD_NS, lock_step=True)
    assert not clock.tell(START_NS)
    assert clock.take(0.0) == START_NS
    assert clock.tell(START_NS)
    assert clock.take(1.0) is None
    assert not clock.tell(START_NS + PERIOD_NS - 1)
    assert clock.take(2.0) is None
    assert not clock.tell(START_NS // 2)
    assert clock.take(3.0) == START_NS // 2
