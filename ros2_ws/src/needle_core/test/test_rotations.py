"""Rotations as messages, against scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_core.rotations import quaternion_from_rotation

HALF_TURNS = [Rotation.from_rotvec(np.pi * axis) for axis in np.eye(3)]
NEAR_NONE = [Rotation.from_rotvec(1e-8 * axis) for axis in np.eye(3)]


@pytest.mark.parametrize(
    "rotation", [*Rotation.random(50, random_state=1), *HALF_TURNS, *NEAR_NONE]
)
def test_a_rotation_is_scipys_quaternion(rotation: Rotation) -> None:
    matrix = rotation.as_matrix()
    quaternion = quaternion_from_rotation(matrix.tolist())
    assert quaternion == tuple(Rotation.from_matrix(matrix).as_quat())
