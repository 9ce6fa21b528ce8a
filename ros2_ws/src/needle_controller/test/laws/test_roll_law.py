"""The roll law: direction, mirrored flips, winding, dead band, torsion, other estimators."""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt
import pytest

from needle_controller.bank.hypothesis_mixture import (
    COLUMNS,
    T_AGREEMENT,
    T_BEHIND_PLAY,
    T_CURVATURE,
    T_LAG,
    T_PLAY,
    T_ROLL,
    T_TIP_ANGLE,
    T_WEIGHT,
    Hypotheses,
    MixtureEstimate,
)
from needle_controller.laws.roll_law import RollLaw
from needle_controller.laws.roll_turns import RollLawSettings, base_turn, nearest_turn
from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import linearized_from_reduced
from needle_controller.observers.estimator import Estimate
from needle_core.errors import OutOfBoundsError

CURVATURE = 1.0 / 0.122
DEG = np.pi / 180.0
CAP = 30.0 * DEG / 0.001


def estimate(
    x: npt.ArrayLike = 0.0,
    pitch: npt.ArrayLike = 0.0,
    roll: npt.ArrayLike = 0.0,
    std: float = 0.0,
) -> Estimate:
    coordinates = np.zeros((*np.broadcast_shapes(np.shape(x), np.shape(roll)), 6))
    coordinates[..., 0], coordinates[..., 4], coordinates[..., 5] = x, pitch, roll
    curvature = np.full(coordinates.shape[:-1], CURVATURE)
    covariance = np.zeros((*coordinates.shape, 6))
    covariance[..., 4, 4] = std**2
    return Estimate(
        coordinates=coordinates,
        linearized=linearized_from_reduced(coordinates[..., [0, 4, 5]], curvature),
        curvature=curvature,
        warnings=(),
        covariance_of=lambda: covariance,
    )


def law(**changes: float) -> RollLaw:
    return RollLaw(RollLawSettings(**changes))


@pytest.mark.parametrize("x", [0.003, -0.003])
def test_turns_to_where_the_needle_bends_towards_the_plane(x: float) -> None:
    """dpitch/dl = curvature sin(roll), (5): above the plane the roll has to become negative."""
    command = law()(estimate(x))
    assert np.sign(command.rotation_rate) == -np.sign(x)
    assert np.sign(command.virtual_input) == -np.sign(x)
    assert abs(command.rotation_rate) == pytest.approx(CAP)


def test_steers_an_exact_needle_into_the_plane() -> None:
    x, pitch, roll = np.array([-0.003, 0.003]), np.array([0.1, 0.1]), np.array([0.4, -0.4])
    steer = law()
    for _ in range(120):
        rate = steer(estimate(x, pitch, roll)).rotation_rate
        for _ in range(10):
            x = x + 1e-4 * np.sin(pitch)
            pitch, roll = (
                pitch + 1e-4 * CURVATURE * np.sin(roll),
                roll + 1e-4 * (rate - CURVATURE * np.cos(roll) * np.tan(pitch)),
            )
    assert np.all(np.abs(x) < 2e-4)


@pytest.mark.parametrize("roll", [-0.5, 0.3, 0.9])
@pytest.mark.parametrize("before", [1.0, -1.0])
def test_a_flip_is_mirrored(roll: float, before: float) -> None:
    """With the wanted sine of the roll there already, a change of sign is a turn by pi - 2 roll."""
    start = roll if before > 0.0 else np.pi - roll
    assert nearest_turn(start, np.sin(roll), before, 0.0, 20.0) == pytest.approx(0.0, abs=1e-9)
    turn = nearest_turn(start, np.sin(roll), -before, 0.0, 20.0)
    assert np.sin(start + turn) == pytest.approx(np.sin(roll))
    assert np.cos(start + turn) == pytest.approx(-np.cos(start))
    wanted = (np.pi - 2.0 * start + np.pi) % (2.0 * np.pi) - np.pi
    assert turn == pytest.approx(wanted)


def test_without_a_wanted_side_the_nearer_one_is_taken() -> None:
    assert nearest_turn(2.8, np.sin(0.2), 0.0, 0.0, 20.0) == pytest.approx(np.pi - 0.2 - 2.8)
    assert nearest_turn(0.3, np.sin(0.2), 0.0, 0.0, 20.0) == pytest.approx(-0.1)


def test_near_the_limit_of_winding_the_other_way_round_is_taken() -> None:
    near, far = nearest_turn(0.0, 0.5, 1.0, 0.0, 7.0), nearest_turn(0.0, 0.5, 1.0, 6.8, 7.0)
    assert near == pytest.approx(np.pi / 6.0)
    assert far == pytest.approx(np.pi / 6.0 - 2.0 * np.pi)
    # On the way there the choice stays the same.
    assert nearest_turn(-0.4, 0.5, 1.0, 6.4, 7.0) == pytest.approx(far + 0.4)
    # With nothing within the limit, the way that unwinds.
    assert nearest_turn(0.0, 0.5, 1.0, 30.0, 7.0) < 0.0
    assert nearest_turn(0.0, -0.5, 1.0, -30.0, 7.0) > 0.0


def test_small_errors_of_the_roll_are_left_alone() -> None:
    settings = RollLawSettings()
    inside, outside = 0.9 * settings.near_dead_band, 1.1 * settings.near_dead_band
    assert law()(estimate(roll=inside)).rotation_rate == 0.0
    assert law()(estimate(roll=outside)).rotation_rate < 0.0


def test_rolls_that_disagree_leave_the_needle_alone() -> None:
    """The less the hypotheses' rolls agree, the larger an error of their mean is left alone."""
    steer = law(near_dead_band=0.1, scatter_dead_band=1.0)
    table = np.zeros((1, COLUMNS))
    table[:, T_CURVATURE], table[:, T_WEIGHT], table[:, T_ROLL] = CURVATURE, 1.0, 0.2
    table[:, T_AGREEMENT] = 1.0
    assert turned(steer, table) == pytest.approx(-0.2)
    table[:, T_AGREEMENT] = 0.85
    assert turned(steer, table) == 0.0


def test_torsion_hypotheses_are_averaged_by_weight() -> None:
    steer = law(near_dead_band=0.1)
    table = np.zeros((2, COLUMNS))
    table[:, T_CURVATURE], table[:, T_AGREEMENT] = CURVATURE, 1.0
    table[:, T_ROLL], table[:, T_WEIGHT] = [0.1, 0.5], [0.25, 0.75]
    table[0, T_ROLL] = 0.05
    # The first is within the dead band and asks for nothing.
    assert turned(steer, table) == pytest.approx(-0.75 * 0.5)


def turned(steer: RollLaw, table: Array) -> float:
    plain = estimate()
    fields = {f.name: getattr(plain, f.name) for f in dataclasses.fields(Estimate)}
    hypotheses = Hypotheses(table, np.zeros(()), np.zeros(()), np.zeros(3))
    command = steer(MixtureEstimate(**fields, hypotheses=hypotheses))
    return float(command.rotation_rate) * steer.settings.step_length


def test_doubt_makes_the_demand_small() -> None:
    sure, unsure = (law(far_dead_band=0.0)(estimate(0.003, 0.0, -0.5, std=s)) for s in (0.0, 0.3))
    assert abs(unsure.virtual_input) < abs(sure.virtual_input)


def row(tip: float = 0.0, behind: float = 0.0, play: float = 0.0, lag: float = 0.0) -> Array:
    values = np.zeros(COLUMNS)
    values[T_TIP_ANGLE], values[T_BEHIND_PLAY] = tip, behind
    values[T_PLAY], values[T_LAG] = play, lag
    return values


def test_play_is_taken_up() -> None:
    assert base_turn(row(play=0.5), 0.2, 0.0, 0.001) == pytest.approx(0.7)
    assert base_turn(row(play=0.5), -0.2, 0.0, 0.001) == pytest.approx(-0.7)
    assert base_turn(row(0.1, 0.1, play=0.5), 0.2, 0.6, 0.001) == pytest.approx(0.2)
    assert base_turn(row(play=0.5), 0.0, 0.3, 0.001) == 0.0


def test_lag_is_led() -> None:
    lead = base_turn(row(lag=0.008), 0.1, 0.0, 0.001)
    assert lead * (1.0 - np.exp(-1.0 / 8.0)) == pytest.approx(0.1)
    # No more turn wanted: the base goes back to where the tip is.
    assert base_turn(row(0.2, 0.9, lag=0.008), 0.0, 0.9, 0.001) == pytest.approx(-0.7)


def test_the_rate_is_limited() -> None:
    rates = law(max_rotation_per_length=100.0)(estimate(np.linspace(-0.01, 0.01, 50))).rotation_rate
    assert rates.shape == (50,)
    assert np.max(np.abs(rates)) <= 100.0


@pytest.mark.parametrize("name", ["step_length", "max_rotation_per_length", "pitch_gain"])
def test_settings_out_of_bounds_are_refused(name: str) -> None:
    with pytest.raises(OutOfBoundsError, match=name):
        law(**{name: -1.0})
