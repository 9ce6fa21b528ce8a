"""Continuous insertion, a sample of what `verify I` runs."""

from __future__ import annotations

import numpy as np
import pytest

from needle_verification.checks.check_continuous import HANDS, SEED, steer
from needle_verification.trials.hand_profiles import FASTEST, constant
from needle_verification.trials.steered_needle import TICK_NS, Hand, rms_at_end

OFFSET = 0.003


def test_a_needle_that_is_pushed_with_jerks_converges() -> None:
    bound, new_hand = HANDS["pushed, jerks to 20 mm/s"]
    needle = steer(new_hand(np.random.default_rng(SEED)), SEED, pushed=True)
    assert needle.steering.state.value == "DONE"
    assert rms_at_end(needle, OFFSET) <= bound * 1e-3
    assert needle.steering.watchdog_trips == 0


def test_nothing_moves_without_the_hold_and_a_needle_goes_on_from_where_it_was() -> None:
    def hand(time: float) -> Hand:
        return constant(FASTEST)(time) if time < 2.0 or time > 4.0 else Hand(False)

    needle = steer(hand, SEED, pushed=False)
    at = np.array(needle.insertions)
    released = slice(round(2.0e9 / TICK_NS), round(4.0e9 / TICK_NS))
    assert np.ptp(at[released]) == 0.0
    assert needle.steering.state.value == "DONE"
    # One of those of which all together come to 0.06 mm.
    assert rms_at_end(needle, OFFSET) <= 1e-4
    assert [outcome for outcome in needle.outcomes if outcome.startswith("aborted")] == [
        "aborted: hold released"
    ]
    # 120 mm at 5 mm/s, and the 2 s: it neither stops nor waits for anything else.
    assert needle.seconds == pytest.approx(26.0, abs=0.5)
