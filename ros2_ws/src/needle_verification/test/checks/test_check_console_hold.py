"""A sample of what `scripts/verify I` runs at full size of the console's hold."""

from __future__ import annotations

from typing import Any

import pytest

from needle_verification.checking import trial_outcomes
from needle_verification.checks import check_console_hold
from needle_verification.trials.chromium import chromium
from patience import GENEROUS_MS

pytest.importorskip("websockets", reason="the console's lock is not installed: scripts/console")


# Chromium takes its time on a busy machine.
@pytest.mark.timeout(300)
@pytest.mark.skipif(chromium() is None, reason="there is no chromium: apt-get install chromium")
def test_the_needle_stops_whatever_is_lost_and_a_fresh_press_moves_it_again() -> None:
    # Each trial begins with a press that moves the needle, after the loss of the one before.
    kinds = (*check_console_hold.LOSSES, "stalled")
    outcomes = trial_outcomes(check_console_hold.TRIALS, 1, *kinds)
    assert tuple(outcome["kind"] for outcome in outcomes) == kinds
    for outcome in outcomes:
        assert outcome["last_motion_ms"] < GENEROUS_MS, outcome
        assert not outcome["resumed"], outcome


def good(**changes: Any) -> dict[str, Any]:
    """A trial that went well."""
    return {"last_motion_ms": 120.0, "way_mm": 0.6, "resumed": False, **changes}


@pytest.mark.parametrize(
    ("loss", "change", "passed"),
    [
        ("closed", {"last_motion_ms": 319.0}, True),
        ("closed", {"last_motion_ms": 321.0}, False),
        ("closed", {"resumed": True}, False),
        ("asleep", {"last_motion_ms": 169.0}, True),
        ("asleep", {"last_motion_ms": 171.0}, False),
    ],
)
def test_what_falls_short_is_a_miss(loss: str, change: dict[str, Any], passed: bool) -> None:
    assert check_console_hold.judge(loss, [good(), good(**change)]).passed is passed
