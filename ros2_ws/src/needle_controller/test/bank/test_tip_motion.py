"""The compiled step and its covariance, against scipy's expm and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from needle_controller.bank.hypothesis_lanes import (
    BEHIND_PLAY,
    BLOCK,
    KAPPA,
    LAG,
    LANES,
    P77,
    PER_SIZE,
    PLAY,
    R00,
    TIP_ANGLE,
    X,
    covariances,
    rows,
    set_covariances,
    set_rows,
)
from needle_controller.bank.tip_motion import LARGEST_TURN, move, rotation_factors
from needle_controller.model.arrays import Array

CASES = [
    (0.001, 0.2),
    (0.001, -0.5),
    (0.002, 0.0),
    (0.001, LARGEST_TURN),
    (0.0, 0.4),
    (0.01, 0.7),
]
PLAYS = np.array([0.0, 0.0, 0.1, 0.25, 0.33, 0.0, 0.0, 0.0])
LAGS = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.004, 0.008, 0.002])
SCALES = np.array([1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1, 1.0, 0.1])


def block(seed: int = 1, *, torsion: bool = False) -> Array:
    """Eight estimates, none like another, as a bank of one needle."""
    rng = np.random.default_rng(seed)
    state = np.zeros((1, 1, BLOCK))
    set_rows(state, X, rng.normal(0.0, 0.01, (1, LANES, 3)))
    set_rows(state, R00, Rotation.random(LANES, random_state=seed).as_matrix().reshape(1, LANES, 9))
    state[0, 0, KAPPA : KAPPA + LANES] = rng.uniform(5.0, 11.0, LANES)
    factor = rng.normal(size=(1, LANES, 8, 8)) * SCALES[:, None]
    set_covariances(state, factor @ np.swapaxes(factor, -1, -2))
    if torsion:
        state[0, 0, PLAY : PLAY + LANES], state[0, 0, LAG : LAG + LANES] = PLAYS, LAGS
    return state


def moved(state: Array, length: float, turn: float) -> Array:
    state = state.copy()
    move(state[0, 0], 0.0, turn, length, 0.0, 0.0, 0.0, 0.0)
    return state


def orientations(state: Array) -> Array:
    return np.asarray(rows(state, R00, 9)[0].reshape(LANES, 3, 3))


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
    before = block()
    after = moved(before, length, turn)
    for h in range(LANES):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = orientations(before)[h], rows(before, X, 3)[0, h]
        x, z = before[0, 0, KAPPA + h] * length, turn
        twist = np.array([[0, -z, 0, 0], [z, 0, -x, 0], [0, x, 0, length], [0, 0, 0, 0.0]])
        wanted = pose @ expm(twist)
        np.testing.assert_allclose(rows(after, X, 3)[0, h], wanted[:3, 3], atol=1e-12)
        np.testing.assert_allclose(orientations(after)[h], wanted[:3, :3], atol=1e-9)


@pytest.mark.parametrize(("length", "turn"), CASES)
@pytest.mark.parametrize("torsion", [False, True])
def test_covariance_goes_by_the_steps_derivative(length: float, turn: float, torsion: bool) -> None:
    """F by central differences of the step itself, in the error's own coordinates."""
    state = block(torsion=torsion)
    after = moved(state, length, turn)

    def end(error: Array) -> Array:
        start = state.copy()
        set_rows(start, X, rows(start, X, 3) + error[:3])
        turned = Rotation.from_rotvec(error[3:6]).as_matrix() @ orientations(start)
        set_rows(start, R00, turned.reshape(1, LANES, 9))
        start[0, 0, KAPPA : KAPPA + LANES] += error[6]
        has_lag = start[0, 0, LAG : LAG + LANES] > 0.0
        start[0, 0, PLAY : PLAY + LANES] += np.where(has_lag, 0.0, error[7])
        start[0, 0, LAG : LAG + LANES] += np.where(has_lag, error[7], 0.0)
        return moved(start, length, turn)

    transition = np.zeros((LANES, 8, 8))
    transition[:, 6, 6] = transition[:, 7, 7] = 1.0
    for i in range(8):
        error = np.zeros(8)
        error[i] = 1e-4 if i == 6 else 1e-6
        if i == 7 and not torsion:
            continue
        ahead, behind = end(error), end(-error)
        transition[:, :3, i] = (rows(ahead, X, 3) - rows(behind, X, 3))[0] / (2.0 * error[i])
        turned = orientations(ahead) @ np.swapaxes(orientations(behind), -1, -2)
        transition[:, 3:6, i] = Rotation.from_matrix(turned).as_rotvec() / (2.0 * error[i])
    # The path's own shift with the torsion is left out: curvature length^2 of what it turns.
    transition[:, :3, 7] = 0.0
    # Without play and lag, more play is less turn; less than none there is not.
    used = slice(2, None) if torsion else slice(None)
    if not torsion:
        ahead, behind = moved(state, length, turn + 1e-6), moved(state, length, turn - 1e-6)
        turned = orientations(ahead) @ np.swapaxes(orientations(behind), -1, -2)
        transition[:, 3:6, 7] = -np.sign(turn) * Rotation.from_matrix(turned).as_rotvec() / 2e-6
    before = covariances(state)[0]
    wanted = transition @ before @ np.swapaxes(transition, -1, -2)
    found = covariances(after)[0]
    deviation = np.sqrt(np.diagonal(wanted, axis1=-2, axis2=-1))
    scale = deviation[:, :, None] * deviation[:, None, :]
    np.testing.assert_allclose((found / scale)[used], (wanted / scale)[used], atol=2e-3)


def test_torsions_angles_are_kept() -> None:
    after = moved(block(torsion=True), 0.001, 0.5)[0, 0]
    tip, behind = after[TIP_ANGLE : TIP_ANGLE + LANES], after[BEHIND_PLAY : BEHIND_PLAY + LANES]
    np.testing.assert_allclose(behind, 0.5 - PLAYS)
    np.testing.assert_allclose(tip[:5], behind[:5])
    assert np.all((tip[5:] > 0.0) & (tip[5:] < behind[5:]))
    np.testing.assert_array_equal(after[PER_SIZE : PER_SIZE + 5], -1.0)


def test_process_noise_is_added_where_it_belongs() -> None:
    state = block(torsion=True)
    set_covariances(state, np.zeros((1, LANES, 8, 8)))
    state[0, 0, P77 + 2 : P77 + LANES] = 1.0
    move(state[0, 0], 0.0, 0.0, 0.0, 2.0, 3.0, 4.0, 5.0)
    added = np.diagonal(covariances(state)[0], axis1=-2, axis2=-1).copy()
    added[2:, 7] -= 1.0
    np.testing.assert_array_equal(added[:, :7], np.tile([0, 0, 0, 2, 2, 2, 3.0], (LANES, 1)))
    # A size that is known exactly stays so; a lag's noise is not a play's.
    np.testing.assert_array_equal(added[:, 7], [0, 0, 4, 4, 4, 5, 5, 5])
