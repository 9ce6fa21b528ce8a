"""Hold messages of one source, with the session that identifies its process."""

from __future__ import annotations

import math

from needle_core.messages import HOLD_LIFETIME, HoldSession, HoldState


def test_a_session_counts_independently_of_the_clock() -> None:
    session = HoldSession("operator")
    holds = [session.next_message(stamp, pressed=stamp > 5, speed=0.5) for stamp in (255, 7, 3)]
    assert holds == [
        HoldState("operator", "ff", 1, True, 0.5, HOLD_LIFETIME),
        HoldState("operator", "ff", 2, True, 0.5, HOLD_LIFETIME),
        HoldState("operator", "ff", 3, False, 0.0, HOLD_LIFETIME),
    ]


def test_a_restarted_process_has_another_session() -> None:
    before, after = (
        HoldSession("operator", math.inf).next_message(at, pressed=True) for at in (16, 0)
    )
    assert (before.session, after.session) == ("10", "0")
    assert (after.count, after.lifetime) == (1, math.inf)
