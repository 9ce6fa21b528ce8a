"""The pose message's orientation and covariance."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from needle_tracker.answers.tracker_messages import ROLL_VARIANCE, orientation, rotation_covariance


def directions() -> np.ndarray:
    drawn = np.random.default_rng(0).normal([0.0, 0.0, 2.0], 1.0, (50, 3))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True))


def test_z_axis_is_the_shaft_and_roll_is_zero() -> None:
    for d in directions():
        rotation = Rotation.from_quat(orientation(d))
        np.testing.assert_allclose(rotation.apply([0.0, 0.0, 1.0]), d, atol=1e-12)
        gamma = rotation.as_euler("XYZ")[2]
        assert abs(gamma) < 1e-9


def test_rotations_of_the_covariance_spread_the_direction() -> None:
    rng = np.random.default_rng(1)
    for d in directions()[:5]:
        across = np.eye(3) - np.outer(d, d)
        root = 0.02 * across @ rng.normal(size=(3, 3))
        wanted = root @ root.T
        covariance = rotation_covariance(d, wanted)
        np.testing.assert_allclose(d @ covariance @ d, ROLL_VARIANCE)
        small = covariance - ROLL_VARIANCE * np.outer(d, d)
        turns = rng.multivariate_normal(np.zeros(3), small, 4000, method="eigh")
        moved = Rotation.from_rotvec(turns).apply(d) - d
        np.testing.assert_allclose(np.cov(moved.T), wanted, atol=0.12 * np.abs(wanted).max())
    assert math.isfinite(ROLL_VARIANCE)
