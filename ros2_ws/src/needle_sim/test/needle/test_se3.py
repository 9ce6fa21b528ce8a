"""exp_twist against scipy's matrix exponential, at all sizes of angle."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from needle_sim.needle.se3 import exp_twist, rotation_about_y, rotation_about_z


def hat(twist: np.ndarray) -> np.ndarray:
    v, w = twist[:3], twist[3:]
    return np.array(
        [[0, -w[2], w[1], v[0]], [w[2], 0, -w[0], v[1]], [-w[1], w[0], 0, v[2]], [0, 0, 0, 0]]
    )


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 1e-3, 0.1, 0.2999, 0.3001, 1.0, 3.1, 6.0])
def test_equals_the_matrix_exponential(angle: float) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        axis = rng.standard_normal(3)
        twist = np.concatenate([rng.standard_normal(3), angle * axis / np.linalg.norm(axis)])
        np.testing.assert_allclose(exp_twist(twist), expm(hat(twist)), rtol=0, atol=3e-14)


def test_broadcasting_equals_looping() -> None:
    twists = np.random.default_rng(2).standard_normal((3, 4, 6))
    together = exp_twist(twists)
    for index in np.ndindex(3, 4):
        np.testing.assert_allclose(together[index], exp_twist(twists[index]), rtol=0, atol=1e-15)


def test_single_axis_rotations_are_exponentials() -> None:
    for angle in (-3.0, -0.2, 0.0, 1.0):
        np.testing.assert_allclose(
            rotation_about_y(angle), expm(hat(np.array([0, 0, 0, 0, angle, 0.0]))), atol=1e-14
        )
        np.testing.assert_allclose(
            rotation_about_z(angle), expm(hat(np.array([0, 0, 0, 0, 0, angle]))), atol=1e-14
        )


def test_a_twist_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match="shape"):
        exp_twist(np.zeros(5))
