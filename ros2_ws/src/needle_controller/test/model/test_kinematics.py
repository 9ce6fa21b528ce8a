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
    SMALLEST_STEERING,
    A,
    B,
    linearized_from_reduced,
    process_covariance,
    reduced_from_linearized,
    rotation_rate,
    transition,
    virtual_input,
)
from needle_controller.model.kinematics import (
    PITCH,
    REDUCED,
    angle_axes,
    angles_from_rotation,
    coordinate_rates,
    reduced_rates,
    rotation_from_angles,
    rotation_from_quaternion,
)

CURVATURE = 1.0 / 0.122


def some_coordinates(count: int) -> Array:
    rng = default_rng(1)
    angles = rng.uniform(-1.0, 1.0, (count, 3)) * [np.pi, 1.4, np.pi]
    return np.concatenate([rng.normal(0.0, 0.02, (count, 3)), angles], axis=1)


def screw(coordinates: Array, rate: float, length: float) -> Array:
    """Flow of the body twist V1 + V2 u of (2) on SE(3), by scipy's expm."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("XYZ", coordinates[3:]).as_matrix()
    pose[:3, 3] = coordinates[:3]
    w1, w3 = CURVATURE, rate
    twist = np.array([[0, -w3, 0, 0], [w3, 0, -w1, 0], [0, w1, 0, 1], [0, 0, 0, 0.0]])
    return np.asarray(pose @ expm(twist * length))


def test_rotations_are_those_of_intrinsic_xyz_angles_and_of_quaternions() -> None:
    angles = some_coordinates(50)[:, 3:]
    expected = Rotation.from_euler("XYZ", angles)
    np.testing.assert_allclose(rotation_from_angles(angles), expected.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(angles_from_rotation(expected.as_matrix()), angles, atol=1e-12)
    np.testing.assert_allclose(
        rotation_from_quaternion(expected.as_quat()), expected.as_matrix(), atol=1e-14
    )


def test_a_turn_is_as_exact_where_it_is_small() -> None:
    vectors = np.outer([0.0, 1e-4, 0.05, 0.0999, 0.1001, 1.0], [2.0 / 7.0, -3.0 / 7.0, 6.0 / 7.0])
    expected = Rotation.from_rotvec(vectors).as_matrix()
    np.testing.assert_allclose(rotation_exp(vectors), expected, rtol=0.0, atol=1e-14)


def test_coordinate_rates_are_the_flow_on_se3() -> None:
    h = 1e-6
    for coordinates, rate in zip(some_coordinates(30), np.linspace(-400, 400, 30), strict=True):
        before, after = (screw(coordinates, rate, length) for length in (-h, h))
        moved = (after[:3, 3] - before[:3, 3]) / (2 * h)
        angles = angles_from_rotation(np.stack([before[:3, :3], after[:3, :3]]))
        turned = np.angle(np.exp(1j * (angles[1] - angles[0]))) / (2 * h)
        rates = coordinate_rates(coordinates, rate, CURVATURE)
        np.testing.assert_allclose(rates, [*moved, *turned], rtol=1e-5, atol=1e-5)
        reduced = reduced_rates(coordinates[list(REDUCED)], rate, CURVATURE)
        np.testing.assert_array_equal(reduced, rates[list(REDUCED)])
    upright = np.zeros(6)
    upright[PITCH] = np.pi / 2
    assert abs(coordinate_rates(upright, 0.0, CURVATURE)[3]) > 1e15


def test_angle_axes_turn_the_tip_as_its_angles_do() -> None:
    angles, h = some_coordinates(20)[:, 3:], 1e-6
    for i in range(3):
        change = np.eye(3)[i] * h
        turn = rotation_from_angles(angles + change) @ np.swapaxes(
            rotation_from_angles(angles - change), -1, -2
        )
        vector = Rotation.from_matrix(turn).as_rotvec() / (2 * h)
        np.testing.assert_allclose(vector, angle_axes(angles)[:, :, i], atol=1e-8)


def test_linearized_state_and_virtual_input_round_trip() -> None:
    reduced = default_rng(2).uniform(-1.0, 1.0, (200, 3)) * [0.01, 1.3, 1.4]
    linearized = linearized_from_reduced(reduced, CURVATURE)
    np.testing.assert_allclose(
        reduced_from_linearized(linearized, CURVATURE), reduced, rtol=0, atol=1e-12
    )
    rate = np.linspace(-500, 500, 200)
    virtual = virtual_input(reduced, rate, CURVATURE)
    np.testing.assert_allclose(rotation_rate(reduced, virtual, CURVATURE), rate, rtol=1e-10)
    # No reduced state is outside the region.
    outside = [[0.0, 1.5, 0.0], [0.0, 0.8, 0.7 * CURVATURE]]
    assert np.all(np.isnan(reduced_from_linearized(outside, CURVATURE)[:, 2]))


def test_inverse_of_7_is_bounded_where_turning_does_not_steer() -> None:
    for roll in (np.pi / 2, -np.pi / 2, np.pi / 2 + 1e-9, np.pi / 2 - 1e-9):
        rate = rotation_rate([0.0, 0.1, roll], 1000.0, CURVATURE)
        assert np.isfinite(rate)
        assert abs(rate) <= (1000.0 / CURVATURE + CURVATURE) / SMALLEST_STEERING


def test_linearized_system_along_a_trajectory_of_the_reduced_one() -> None:
    """ds/dl = A s + B v of (8) holds along (5), whatever u does."""

    def rate_at(length: float) -> float:
        return 20.0 * math.sin(60.0 * length) - 5.0

    solution = solve_ivp(
        lambda length, r: reduced_rates(r, rate_at(length), CURVATURE),
        (0.0, 0.1),
        [-0.003, 0.2, 0.4],
        rtol=1e-11,
        atol=1e-13,
        dense_output=True,
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
        # Van Loan's.
        block = np.block([[-A, density], [np.zeros((3, 3)), A.T]]) * length
        exponential = expm(block)
        expected = exponential[3:, 3:].T @ exponential[:3, 3:]
        np.testing.assert_allclose(process_covariance(density, length), expected, rtol=1e-12)
