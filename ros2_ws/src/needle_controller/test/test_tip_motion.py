"""The compiled step and its covariance, against scipy's expm and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from needle_controller.arrays import Array
from needle_controller.tip_motion import move, propagate, rotate, rotation_factors

CASES = [
    (0.001, 0.2),
    (0.001, -0.5),
    (0.002, 0.0),
    (0.001, 3.0),
    (0.0, 0.4),
    (0.01, 1.0),
]


def start(seed: int = 1) -> tuple[Array, Array, float]:
    rng = np.random.default_rng(seed)
    return rng.normal(0.0, 0.01, 3), Rotation.random(random_state=seed).as_matrix(), 8.2


def moved(
    position: Array, rotation: Array, curvature: float, length: float, turn: float
) -> tuple[Array, Array, Array]:
    position, rotation, sensitivity = position.copy(), rotation.copy(), np.empty(9)
    move(position, rotation, curvature, length, turn, sensitivity)
    return position, rotation, sensitivity


@pytest.mark.parametrize("squared", [0.0, 1e-8, 0.49, 0.51, 9.0])
def test_rodrigues_factors_do_not_jump(squared: float) -> None:
    angle = np.sqrt(squared) if squared > 1e-6 else 1e-3
    wanted = [
        np.sin(angle) / angle,
        (1.0 - np.cos(angle)) / angle**2,
        (angle - np.sin(angle)) / angle**3,
    ]
    assert rotation_factors(squared) == pytest.approx(wanted, rel=2e-6)


@pytest.mark.parametrize(("length", "turn"), CASES)
def test_the_step_is_the_exponential_of_the_twist(length: float, turn: float) -> None:
    position, rotation, curvature = start()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position
    x, z = curvature * length, turn
    twist = np.array([[0, -z, 0, 0], [z, 0, -x, 0], [0, x, 0, length], [0, 0, 0, 0.0]])
    wanted = pose @ expm(twist)
    end, turned, _ = moved(position, rotation, curvature, length, turn)
    np.testing.assert_allclose(end, wanted[:3, 3], atol=1e-12)
    np.testing.assert_allclose(turned, wanted[:3, :3], atol=1e-9)


def test_rotate_turns_about_the_frames_axes() -> None:
    _, rotation, _ = start()
    vector = np.array([0.3, -0.2, 0.5])
    turned = rotation.copy()
    rotate(turned, *vector)
    np.testing.assert_allclose(turned, Rotation.from_rotvec(vector).as_matrix() @ rotation)


@pytest.mark.parametrize(("length", "turn"), CASES)
def test_covariance_goes_by_the_steps_derivative(length: float, turn: float) -> None:
    """F by central differences of the step itself, in the error's own coordinates."""
    position, rotation, curvature = start()
    turn_per_torsion = -0.7

    def end(error: Array) -> tuple[Array, ...]:
        r = Rotation.from_rotvec(error[3:6]).as_matrix() @ rotation
        return moved(
            position + error[:3],
            r,
            curvature + error[6],
            length,
            turn + turn_per_torsion * error[7],
        )[:2]

    _, _, sensitivity = moved(position, rotation, curvature, length, turn)
    transition = np.zeros((8, 8))
    transition[6, 6] = transition[7, 7] = 1.0
    for i in range(8):
        error = np.zeros(8)
        error[i] = 1e-4 if i == 6 else 1e-6
        ahead, behind = end(error), end(-error)
        transition[:3, i] = (ahead[0] - behind[0]) / (2.0 * error[i])
        turned = Rotation.from_matrix(ahead[1] @ behind[1].T).as_rotvec()
        transition[3:6, i] = turned / (2.0 * error[i])
    # The path's own shift with the torsion is left out: of the order of curvature length^2.
    assert np.max(np.abs(transition[:3, 7])) <= curvature * length**2
    transition[:3, 7] = 0.0

    rng = np.random.default_rng(2)
    factor = (
        rng.normal(size=(8, 8)) * np.array([1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1, 1.0, 0.1])[:, None]
    )
    covariance = factor @ factor.T
    wanted = transition @ covariance @ transition.T
    propagate(covariance, sensitivity, length, turn_per_torsion, 0.0, 0.0)
    deviation = np.sqrt(np.diag(wanted))
    scale = np.outer(deviation, deviation)
    np.testing.assert_allclose(covariance / scale, wanted / scale, atol=1e-3)
    np.testing.assert_allclose(covariance / scale, covariance.T / scale, atol=1e-12)


def test_process_noise_is_added_where_it_belongs() -> None:
    covariance = np.zeros((8, 8))
    propagate(covariance, np.zeros(9), 0.001, 0.0, 2.0, 3.0)
    np.testing.assert_array_equal(np.diag(covariance), [0, 0, 0, 2, 2, 2, 3, 0])
