"""The compiled step and its covariance, against scipy's expm and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from needle_controller.bank.estimate_tiles import (
    BEHIND_PLAY,
    E_KAPPA,
    E_SCALE,
    E_SIZE,
    ERROR,
    KAPPA,
    LAG,
    PAIRS,
    PER_SIZE,
    PLACE,
    PLAY,
    ROWS,
    SCALE,
    TIP_ANGLE,
    P,
    R,
    Tiles,
    X,
    covariances,
    lower_half,
    rows,
    set_rows,
    tiles_of,
)
from needle_controller.bank.filter_settings import Drift
from needle_controller.bank.tip_motion import (
    LARGEST_TURN,
    MOTION_ROWS,
    move,
    rotation_factors,
)
from needle_controller.model.arrays import Array

CASES = [
    (0.001, 0.2),
    (0.001, -0.5),
    (0.002, 0.0),
    (0.001, LARGEST_TURN),
    (0.0, 0.4),
    (0.01, 0.7),
]
COUNT = 8
PLAYS = np.array([0.0, 0.0, 0.1, 0.25, 0.33, 0.0, 0.0, 0.0])
LAGS = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.004, 0.008, 0.002])
SCALES = np.array([1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1, 1.0, 0.1, 0.05])
NO_DRIFT = Drift(0.0, 0.0, 0.0, 0.0, 0.0)


def estimates(seed: int = 1, *, torsion: bool = False) -> Tiles:
    """Eight estimates of a needle, none like another."""
    rng = np.random.default_rng(seed)
    numbers = np.zeros((COUNT, ROWS))
    numbers[:, X : X + 3] = rng.normal(0.0, 0.01, (COUNT, 3))
    numbers[:, R : R + 9] = Rotation.random(COUNT, random_state=seed).as_matrix().reshape(-1, 9)
    numbers[:, KAPPA] = rng.uniform(5.0, 11.0, COUNT)
    numbers[:, SCALE] = rng.uniform(0.9, 1.1, COUNT)
    factor = rng.normal(size=(COUNT, ERROR, ERROR)) * SCALES[:, None]
    numbers[:, P : P + PAIRS] = lower_half(factor @ np.swapaxes(factor, -1, -2))
    if torsion:
        numbers[:, PLAY], numbers[:, LAG] = PLAYS, LAGS
    return tiles_of(numbers, np.array([COUNT]))


def copied(tiles: Tiles) -> Tiles:
    return tiles._replace(state=tiles.state.copy())


def moved(tiles: Tiles, length: float, turn: float, drift: Drift = NO_DRIFT) -> Tiles:
    tiles = copied(tiles)
    lanes = tiles.state.shape[2]
    move(
        tiles.state[0],
        np.zeros(lanes),
        np.full(lanes, turn),
        np.full(lanes, length),
        drift,
        np.empty((MOTION_ROWS, lanes)),
    )
    return tiles


def orientations(tiles: Tiles) -> Array:
    return np.asarray(rows(tiles, R, 9).reshape(-1, 3, 3))


@pytest.mark.parametrize("angle", [1e-3, 0.5, 1.0, 2.0])
def test_rodrigues_factors(angle: float) -> None:
    wanted = [
        np.sin(angle) / angle,
        (1.0 - np.cos(angle)) / angle**2,
        (angle - np.sin(angle)) / angle**3,
    ]
    assert rotation_factors(angle**2) == pytest.approx(wanted, rel=1e-6 if angle < 0.01 else 5e-8)


@pytest.mark.parametrize(("length", "turn"), CASES)
def test_the_step_is_the_exponential_of_the_twist(length: float, turn: float) -> None:
    before = estimates()
    after = moved(before, length, turn)
    for h in range(COUNT):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = orientations(before)[h], rows(before, X, 3)[h]
        gone = rows(before, SCALE, 1)[h, 0] * length
        x, z = rows(before, KAPPA, 1)[h, 0] * gone, turn
        twist = np.array([[0, -z, 0, 0], [z, 0, -x, 0], [0, x, 0, gone], [0, 0, 0, 0.0]])
        wanted = pose @ expm(twist)
        np.testing.assert_allclose(rows(after, X, 3)[h], wanted[:3, 3], atol=1e-12)
        np.testing.assert_allclose(orientations(after)[h], wanted[:3, :3], atol=1e-9)


@pytest.mark.parametrize(("length", "turn"), CASES)
@pytest.mark.parametrize("torsion", [False, True])
def test_covariance_goes_by_the_steps_derivative(length: float, turn: float, torsion: bool) -> None:
    """F by central differences of the step itself, in the error's own coordinates."""
    tiles = estimates(torsion=torsion)
    after = moved(tiles, length, turn)
    has_lag = rows(tiles, LAG, 1) > 0.0

    def end(error: Array) -> Tiles:
        start = copied(tiles)
        set_rows(start, X, rows(start, X, 3) + error[:3])
        turned = Rotation.from_rotvec(error[3:6]).as_matrix() @ orientations(start)
        set_rows(start, R, turned.reshape(-1, 9))
        set_rows(start, KAPPA, rows(start, KAPPA, 1) + error[E_KAPPA])
        set_rows(start, SCALE, rows(start, SCALE, 1) + error[E_SCALE])
        set_rows(start, PLAY, rows(start, PLAY, 1) + np.where(has_lag, 0.0, error[E_SIZE]))
        set_rows(start, LAG, rows(start, LAG, 1) + np.where(has_lag, error[E_SIZE], 0.0))
        return moved(start, length, turn)

    transition = np.zeros((COUNT, ERROR, ERROR))
    transition[:, range(6, ERROR), range(6, ERROR)] = 1.0
    for i in range(ERROR):
        error = np.zeros(ERROR)
        error[i] = 1e-4 if i == E_KAPPA else 1e-6
        if i == E_SIZE and not torsion:
            continue
        ahead, behind = end(error), end(-error)
        transition[:, :3, i] = (rows(ahead, X, 3) - rows(behind, X, 3)) / (2.0 * error[i])
        turned = orientations(ahead) @ np.swapaxes(orientations(behind), -1, -2)
        transition[:, 3:6, i] = Rotation.from_matrix(turned).as_rotvec() / (2.0 * error[i])
    # The path's own shift with the torsion is left out: curvature length^2 of what it turns.
    transition[:, :3, E_SIZE] = 0.0
    # Without play and lag, more play is less turn; less than none there is not.
    used = slice(2, None) if torsion else slice(None)
    if not torsion:
        ahead, behind = moved(tiles, length, turn + 1e-6), moved(tiles, length, turn - 1e-6)
        turned = orientations(ahead) @ np.swapaxes(orientations(behind), -1, -2)
        by_turn = Rotation.from_matrix(turned).as_rotvec() / 2e-6
        transition[:, 3:6, E_SIZE] = -np.sign(turn) * by_turn
    before = covariances(tiles)
    wanted = transition @ before @ np.swapaxes(transition, -1, -2)
    found = covariances(after)
    deviation = np.sqrt(np.diagonal(wanted, axis1=-2, axis2=-1))
    scale = deviation[:, :, None] * deviation[:, None, :]
    np.testing.assert_allclose((found / scale)[used], (wanted / scale)[used], atol=2e-3)


@pytest.mark.parametrize("torsion", [False, True])
def test_where_nothing_moves_not_a_bit_changes(torsion: bool) -> None:
    """So a lane can wait while others go on."""
    tiles = moved(estimates(torsion=torsion), 0.001, 0.3)
    drift = Drift(1.0, 1.0, 1.0, 1.0, 1.0)
    # The base stays where it is: its angle before is 0 here.
    tiles.state[:, [TIP_ANGLE, BEHIND_PLAY]] = 0.0
    np.testing.assert_array_equal(moved(tiles, 0.0, 0.0, drift).state, tiles.state)


def test_torsions_angles_are_kept() -> None:
    after = moved(estimates(torsion=True), 0.001, 0.5)
    tip, behind = rows(after, TIP_ANGLE, 1)[:, 0], rows(after, BEHIND_PLAY, 1)[:, 0]
    np.testing.assert_allclose(behind, 0.5 - PLAYS)
    np.testing.assert_allclose(tip[:5], behind[:5])
    assert np.all((tip[5:] > 0.0) & (tip[5:] < behind[5:]))
    np.testing.assert_array_equal(rows(after, PER_SIZE, 1)[:5], -1.0)


def test_process_noise_is_added_where_it_belongs() -> None:
    tiles = estimates(torsion=True)
    tiles.state[:, P : P + PAIRS] = 0.0
    tiles.state[0, PLACE[E_SIZE, E_SIZE], 2:COUNT] = 1.0
    before = covariances(tiles)
    added = covariances(moved(tiles, 0.001, 0.0, Drift(2.0, 3.0, 4.0, 5.0, 6.0))) - before
    added[:, :6, 6:] = added[:, 6:, :6] = added[:, :3] = added[:, :, :3] = 0.0
    added = 1000.0 * np.diagonal(added, axis1=-2, axis2=-1)
    wanted = np.tile([0, 0, 0, 2, 2, 2, 3, 0, 4.0], (COUNT, 1))
    # A size that is known exactly stays so; a lag's noise is not a play's.
    wanted[:, E_SIZE] = [0, 0, 5, 5, 5, 6, 6, 6]
    np.testing.assert_allclose(added, wanted, atol=1e-3)
