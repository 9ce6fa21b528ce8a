"""(3) to (8) of [KC09] against scipy: exponentials, Euler angles, integrated trajectories."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import default_rng
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from needle_controller.model.arc_motion import rotation_exp
from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import (
    A,
    B,
    linearized_from_reduced,
    process_covariance,
    reduced_from_linearized,
    transition,
    virtual_input,
)
from needle_controller.model.kinematics import (
    angle_axes,
    angles_from_rotation,
    rotation_from_angles,
)

CURVATURE = 1.0 / 0.122


def some_coordinates(count: int) -> Array:
    rng = default_rng(1)
    angles = rng.uniform(-1.0, 1.0, (count, 3)) * [np.pi, 1.4, np.pi]
    return np.concatenate([rng.normal(0.0, 0.02, (count, 3)), angles], axis=1)


def test_rotations_equal_scipys_intrinsic_xyz() -> None:
    angles = some_coordinates(50)[:, 3:]
    expected = Rotation.from_euler("XYZ", angles)
    np.testing.assert_allclose(rotation_from_angles(angles), expected.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(angles_from_rotation(expected.as_matrix()), angles, atol=1e-12)


def test_small_rotations_are_exact() -> None:
    vectors = np.outer([0.0, 1e-4, 0.05, 0.0999, 0.1001, 1.0], [2.0 / 7.0, -3.0 / 7.0, 6.0 / 7.0])
    expected = Rotation.from_rotvec(vectors).as_matrix()
    np.testing.assert_allclose(rotation_exp(vectors), expected, rtol=0.0, atol=1e-14)


def test_angle_axes_are_the_derivatives_of_the_rotation() -> None:
    angles, h = some_coordinates(20)[:, 3:], 1e-6
    for i in range(3):
        change = np.eye(3)[i] * h
        turn = rotation_from_angles(angles + change) @ np.swapaxes(
            rotation_from_angles(angles - change), -1, -2
        )
        vector = Rotation.from_matrix(turn).as_rotvec() / (2 * h)
        np.testing.assert_allclose(vector, angle_axes(angles)[:, :, i], atol=1e-8)


def test_linearized_state_round_trip() -> None:
    reduced = default_rng(2).uniform(-1.0, 1.0, (200, 3)) * [0.01, 1.3, 1.4]
    linearized = linearized_from_reduced(reduced, CURVATURE)
    np.testing.assert_allclose(
        reduced_from_linearized(linearized, CURVATURE), reduced, rtol=0, atol=1e-12
    )
    # Outside the region there is no reduced state.
    outside = [[0.0, 1.5, 0.0], [0.0, 0.8, 0.7 * CURVATURE]]
    assert np.all(np.isnan(reduced_from_linearized(outside, CURVATURE)[:, 2]))


def test_the_linearized_system_holds_along_a_reduced_trajectory() -> None:
    """ds/dl = A s + B v of (8) holds along (5) for any u."""

    def rate_at(length: float) -> float:
        return 20.0 * math.sin(60.0 * length) - 5.0

    def rates(length: float, r: Array) -> list[float]:
        # Equation (5) of the paper.
        _, pitch, roll = r
        drift = -CURVATURE * math.cos(roll) * math.tan(pitch)
        return [math.sin(pitch), CURVATURE * math.sin(roll), drift + rate_at(length)]

    solution = solve_ivp(
        rates, (0.0, 0.1), [-0.003, 0.2, 0.4], rtol=1e-11, atol=1e-13, dense_output=True
    )
    h = 1e-5
    for length in np.linspace(0.01, 0.09, 9):
        s_before, s, s_after = (
            linearized_from_reduced(solution.sol(at), CURVATURE)
            for at in (length - h, length, length + h)
        )
        v = virtual_input(solution.sol(length), rate_at(length), CURVATURE)
        expected = A @ s + B[:, 0] * v
        np.testing.assert_allclose((s_after - s_before) / (2 * h), expected, rtol=1e-4, atol=1e-6)


def test_transition_and_process_covariance_are_matrix_exponentials() -> None:
    density = np.array([[2.0, 0.3, 0.1], [0.3, 5.0, -1.0], [0.1, -1.0, 9.0]])
    for length in (0.0, 1e-3, 0.2):
        np.testing.assert_allclose(transition(length), expm(A * length), atol=1e-15)
        # Van Loan's method.
        block = np.block([[-A, density], [np.zeros((3, 3)), A.T]]) * length
        exponential = expm(block)
        expected = exponential[3:, 3:].T @ exponential[:3, 3:]
        np.testing.assert_allclose(process_covariance(density, length), expected, rtol=1e-12)
