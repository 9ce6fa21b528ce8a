"""The roll law: direction, mirrored flips, winding, dead band, torsion."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from needle_controller.filter.records import TORSION
from needle_controller.laws.roll_law import (
    RollLaw,
    RollLawSettings,
    base_turn,
    bend_sign,
    check_flips,
    nearest_turn,
)
from needle_controller.observers.estimator import Estimate
from needle_core.errors import UserError

from .estimates import CAP, STEP, known, mixture


def estimate(x: float = 0.0, pitch: float = 0.0, roll: float = 0.0, std: float = 0.0) -> Estimate:
    return known(np.array([x, 0.0, 0.0, 0.0, pitch, roll]), std)


def law(**changes: float) -> RollLaw:
    return RollLaw(RollLawSettings(**changes))


def test_turns_the_bend_towards_the_plane_within_the_limit() -> None:
    """dpitch/dl = curvature sin(roll), (5): above the plane the roll must become negative."""
    for x in (0.003, -0.003):
        command = law()(estimate(x))
        assert np.sign(command.rotation_rate) == np.sign(command.virtual_input) == -np.sign(x)
        assert abs(command.rotation_rate) == pytest.approx(CAP)
    slow = law(max_rotation_per_length=100.0)
    for x in np.linspace(-0.01, 0.01, 50).tolist():
        assert abs(slow(estimate(x)).rotation_rate) <= 100.0
    # Uncertainty reduces the desired s3.
    sure, unsure = (law(far_dead_band=0.0)(estimate(0.0002, 0.0, -0.1, std=s)) for s in (0.0, 0.3))
    assert abs(unsure.virtual_input) < abs(sure.virtual_input)


def test_a_flip_is_mirrored() -> None:
    """At the desired sine of the roll, a change of sign is a turn by pi - 2 roll."""
    for roll, before in ((-0.5, 1.0), (0.9, 1.0), (-0.5, -1.0), (0.9, -1.0)):
        start = roll if before > 0.0 else np.pi - roll
        assert nearest_turn(start, np.sin(roll), before, 0.0, 20.0) == pytest.approx(0.0, abs=1e-9)
        turn = nearest_turn(start, np.sin(roll), -before, 0.0, 20.0)
        assert np.sin(start + turn) == pytest.approx(np.sin(roll))
        assert np.cos(start + turn) == pytest.approx(-np.cos(start))
        assert abs(turn) <= np.pi


def test_flips_are_planned_at_depths_that_increase() -> None:
    depths = (0.0, 0.0299, 0.0301, 0.0699, 0.0701)
    assert [bend_sign((0.03, 0.07), at) for at in depths] == [1, 1, -1, -1, 1]
    assert bend_sign((), 0.05) == 0.0
    with pytest.raises(UserError, match="flip 2"):
        check_flips((0.05, 0.05), 0.1)


def test_the_shorter_turn_is_chosen_within_the_winding_limit() -> None:
    assert nearest_turn(2.8, np.sin(0.2), 0.0, 0.0, 20.0) == pytest.approx(np.pi - 0.2 - 2.8)
    assert nearest_turn(0.3, np.sin(0.2), 0.0, 0.0, 20.0) == pytest.approx(-0.1)
    near, far = nearest_turn(0.0, 0.5, 1.0, 0.0, 7.0), nearest_turn(0.0, 0.5, 1.0, 6.8, 7.0)
    assert near == pytest.approx(np.pi / 6.0)
    assert far == pytest.approx(np.pi / 6.0 - 2.0 * np.pi)
    # The choice stays the same during the turn.
    assert nearest_turn(-0.4, 0.5, 1.0, 6.4, 7.0) == pytest.approx(far + 0.4)
    # If every turn exceeds the limit, the one that unwinds is chosen.
    assert nearest_turn(0.0, 0.5, 1.0, 30.0, 7.0) < 0.0
    assert nearest_turn(0.0, -0.5, 1.0, -30.0, 7.0) > 0.0


def turned(needle: Estimate, **changes: float) -> float:
    return float(law(near_dead_band=0.1, far_dead_band=0.1, **changes)(needle).rotation_rate) * STEP


def test_small_errors_and_disagreeing_rolls_are_not_corrected() -> None:
    band = RollLawSettings().near_dead_band
    assert law()(estimate(roll=0.9 * band)).rotation_rate == 0.0
    assert law()(estimate(roll=1.1 * band)).rotation_rate < 0.0
    assert turned(mixture([0.2])) == pytest.approx(-0.2)
    # The dead band grows with the disagreement of the rolls.
    assert turned(mixture([0.2], agreement=0.85)) == 0.0
    # Averaged by weight; the first is within the dead band.
    weighed = mixture([0.05, 0.5], weight=0.5 / 3.0)
    assert turned(weighed) == pytest.approx(-0.75 * 0.5)


def torsion(tip: float = 0.0, behind: float = 0.0, **sizes: float) -> Any:
    made = np.zeros(1, TORSION)[0]
    for name, value in {"tip_angle": tip, "behind_play": behind, "gain": 1.0, **sizes}.items():
        made[name] = value
    return made


def test_play_and_lag_are_compensated() -> None:
    assert base_turn(torsion(play=0.5), 0.2, 0.0, STEP) == pytest.approx(0.7)
    assert base_turn(torsion(play=0.5), -0.2, 0.0, STEP) == pytest.approx(-0.7)
    assert base_turn(torsion(0.1, 0.1, play=0.5), 0.2, 0.6, STEP) == pytest.approx(0.2)
    assert base_turn(torsion(play=0.5), 0.0, 0.3, STEP) == 0.0
    lead = base_turn(torsion(lag=0.008), 0.1, 0.0, STEP)
    assert lead * (1.0 - np.exp(-1.0 / 8.0)) == pytest.approx(0.1)
    # Half of the base rotation reaches the tip.
    assert base_turn(torsion(0.3, 0.3, gain=0.5), 0.1, 0.6, STEP) == pytest.approx(0.2)
    # Without a further turn, the base returns to the angle of the tip.
    assert base_turn(torsion(0.2, 0.9, lag=0.008), 0.0, 0.9, STEP) == pytest.approx(-0.7)
