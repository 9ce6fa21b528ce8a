"""Quaternions and rotation matrices, compared with scipy."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from needle_core.rotations import quaternion_from_rotation, rotation_from_quaternion

AXES = np.eye(3)


def test_a_rotation_gives_scipys_quaternion() -> None:
    turns = Rotation.from_rotvec(np.vstack([np.pi * AXES, 1e-8 * AXES]))
    for rotation in (*Rotation.random(50, random_state=1), *turns):
        matrix = rotation.as_matrix()
        quaternion = quaternion_from_rotation(matrix.tolist())
        assert quaternion == tuple(Rotation.from_matrix(matrix).as_quat())
        np.testing.assert_allclose(rotation_from_quaternion(quaternion), matrix, atol=1e-14)
