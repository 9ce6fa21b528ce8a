"""Play and lag of the estimator's torsion, against a fine integration and finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from needle_controller.filter.motion import turn_tip
from needle_controller.model.arrays import Array

TURNS = np.array([0.5, 0.3, -0.2, -0.9, 0.0, -0.4, 1.2, 0.1])
LENGTH = 0.001


def tips(play: float, lag: float, turns: Array = TURNS, length: float = LENGTH) -> Array:
    tip = behind = per_size = base = 0.0
    results = []
    for turn in turns:
        tip, behind, per_size = turn_tip(tip, behind, per_size, base, turn, length, play, lag)
        base += turn
        results.append((tip, per_size))
    return np.array(results)


@pytest.mark.parametrize(("play", "lag"), [(0.0, 0.0), (0.3, 0.0), (0.0, 0.008), (0.3, 0.004)])
def test_against_fine_integration(play: float, lag: float) -> None:
    tip = behind = base = 0.0
    wanted = []
    parts = 20000
    for turn in TURNS:
        for _ in range(parts):
            base += turn / parts
            behind = min(max(behind, base - play), base + play)
            tip = behind if lag == 0.0 else tip + (behind - tip) * LENGTH / parts / lag
        wanted.append(tip)
    np.testing.assert_allclose(tips(play, lag)[:, 0], wanted, atol=3e-5)


def test_with_lag_a_needle_at_rest_does_not_turn() -> None:
    assert tips(0.0, 0.008, length=0.0)[-1, 0] == 0.0


def test_dividing_a_step_changes_nothing_once_the_play_is_closed() -> None:
    whole = tips(0.2, 0.006, np.array([0.5, 0.4]))
    divided = tips(0.2, 0.006, np.repeat([0.05, 0.04], 10), LENGTH / 10)
    np.testing.assert_allclose(divided[[9, 19]], whole, rtol=1e-9)
