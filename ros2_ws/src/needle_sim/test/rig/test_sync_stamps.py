"""Which simulated time a SYNC gets."""

from __future__ import annotations

import random

from needle_sim.rig.sync_stamps import SyncStamps

TICK = 20


def begun() -> SyncStamps:
    stamps = SyncStamps(0.2)
    stamps.hear(1000)
    stamps.sync(1, 0.0)
    # Was there one before? Nobody knows: patience.
    assert stamps.take(0.1, simulated=True) is None
    assert stamps.take(0.2, simulated=True) == 1000
    return stamps


def test_a_sync_before_the_first_time_waits_for_it() -> None:
    stamps = SyncStamps(0.2)
    stamps.sync(1, 0.0)
    assert stamps.take(5.0, simulated=True) is None
    stamps.hear(1000)
    assert stamps.take(5.0, simulated=True) == 1000
    stamps.hear(1020)
    stamps.sync(1, 5.1)
    assert stamps.take(5.1, simulated=True) == 1020


def test_time_may_come_before_or_after_its_sync() -> None:
    rng = random.Random(3)
    stamps = begun()
    for time_ns in range(1020, 3000, TICK):
        if rng.random() < 0.5:
            stamps.hear(time_ns)
            stamps.sync(1, 1.0)
        else:
            stamps.sync(1, 1.0)
            assert stamps.take(1.0, simulated=True) is None
            # Repeated for whoever comes late: no new time.
            stamps.hear(time_ns - TICK)
            assert stamps.take(1.0, simulated=True) is None
            stamps.hear(time_ns)
        assert stamps.take(1.0, simulated=True) == time_ns
        assert not stamps.waits


def test_sync_after_times_without_any_waits_for_the_newest() -> None:
    stamps = begun()
    stamps.hear(1020)
    stamps.hear(1040)
    stamps.sync(1, 5.0)
    assert stamps.take(5.0, simulated=True) is None
    stamps.hear(1060)
    assert stamps.take(5.2, simulated=True) == 1060
    stamps.hear(1080)
    stamps.sync(1, 6.0)
    assert stamps.take(6.0, simulated=True) == 1080


def test_time_stands_on_the_wall_for_a_process_that_was_held_up() -> None:
    stamps = begun()
    # A minute later: patience counts from the SYNC, not from the last look.
    stamps.sync(1, 60.0)
    assert stamps.take(60.0, simulated=True) is None
    stamps.hear(1020)
    assert stamps.take(60.0, simulated=True) == 1020


def test_without_simulated_time_nothing_waits() -> None:
    stamps = SyncStamps(0.2)
    stamps.sync(1, 0.0)
    assert stamps.take(0.0, simulated=False) == 0
