"""Quaternions and rotation matrices, compared with scipy."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from needle_core.rotations import (
    quaternion_from_rotation,
    received_rotation,
    rotation_from_quaternion,
)

AXES = np.eye(3)


def test_a_rotation_gives_scipys_quaternion() -> None:
    turns = Rotation.from_rotvec(np.vstack([np.pi * AXES, 1e-8 * AXES]))
    for rotation in (*Rotation.random(50, random_state=1), *turns):
        matrix = rotation.as_matrix()
        quaternion = quaternion_from_rotation(matrix.tolist())
        assert quaternion == tuple(Rotation.from_matrix(matrix).as_quat())
        np.testing.assert_allclose(rotation_from_quaternion(quaternion), matrix, atol=1e-14)


def test_an_unset_or_implausible_orientation_is_no_rotation() -> None:
    for length in (0.0, 0.5, 2.0, 1e300):
        assert received_rotation((0.0, 0.0, 0.0, length)) is None
    for length in (0.51, 1.99):
        found = received_rotation((0.0, 0.0, length, 0.0))
        assert found is not None
        np.testing.assert_allclose(found, np.diag([-1.0, -1.0, 1.0]), atol=1e-14)
