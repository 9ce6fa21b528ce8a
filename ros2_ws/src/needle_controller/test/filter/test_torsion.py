"""Play and lag of the estimator's torsion, against a fine integration and finite differences."""

from __future__ import annotations

import pytest

from needle_controller.filter.motion import turn_tip

TURNS = (0.5, 0.3, -0.2, -0.9, 0.0, -0.4, 1.2, 0.1)
LENGTH = 0.001
PARTS = 20_000


@pytest.mark.parametrize(("play", "lag"), [(0.0, 0.0), (0.3, 0.0), (0.0, 0.008), (0.3, 0.004)])
def test_against_fine_integration(play: float, lag: float) -> None:
    found = found_behind = tip = behind = base = 0.0
    for turn in TURNS:
        found, found_behind, _ = turn_tip(found, found_behind, 0.0, base, turn, LENGTH, play, lag)
        for _ in range(PARTS):
            base += turn / PARTS
            behind = min(max(behind, base - play), base + play)
            tip = behind if lag == 0.0 else tip + (behind - tip) * LENGTH / PARTS / lag
        assert found == pytest.approx(tip, abs=3e-5)


def test_with_lag_a_needle_at_rest_does_not_turn() -> None:
    tip, _, _ = turn_tip(0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.008)
    assert tip == 0.0
