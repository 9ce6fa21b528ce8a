"""The pitch that a measured direction of the shaft says."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.random import default_rng
from scipy.spatial.transform import Rotation

from needle_controller.model.kinematics import PITCH, angles_from_rotation
from needle_controller.observers.measured_pitch import LARGEST_PITCH_STD, measured_pitch

KNOWN = np.eye(3) * 1e-6


def test_it_is_the_pitch_of_the_target_plane_s_coordinates() -> None:
    rng = default_rng(1)
    for _ in range(20):
        needle, plane = Rotation.random(2, rng).as_matrix()
        in_plane = plane.T @ needle
        pitch = measured_pitch(needle[:, 2], KNOWN, plane.T)
        assert pitch == pytest.approx(angles_from_rotation(in_plane)[PITCH - 3], abs=1e-9)


def test_its_spread_decides_whether_it_counts() -> None:
    """What turns the direction within the plane, or about itself, leaves the pitch alone."""
    assert math.isnan(measured_pitch(np.array([0.0, 0.0, 1.0]), np.zeros((3, 3)), np.eye(3)))
    along, pitch = np.array([0.2, -0.3, math.sqrt(1.0 - 0.13)]), math.asin(0.2)
    wide = (1.1 * LARGEST_PITCH_STD) ** 2
    yaw_axis = np.array([1.0, 0.0, 0.0])
    for axis in (along, yaw_axis):
        covariance = np.outer(axis, axis) * 100.0 * wide + KNOWN
        assert measured_pitch(along, covariance, np.eye(3)) == pytest.approx(pitch)
    across = np.cross(along, yaw_axis)
    across /= np.linalg.norm(across)
    assert math.isnan(measured_pitch(along, np.outer(across, across) * wide, np.eye(3)))
    assert not math.isnan(measured_pitch(along, np.outer(across, across) * wide / 1.5, np.eye(3)))


def test_a_direction_that_is_none_is_not_measured() -> None:
    assert math.isnan(measured_pitch(np.zeros(3), KNOWN, np.eye(3)))
    assert math.isnan(measured_pitch(np.array([0.0, 0.1, 1.1]), KNOWN, np.eye(3)))


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_is_not_measured(bad: float) -> None:
    assert math.isnan(measured_pitch(np.array([bad, 0.0, 1.0]), KNOWN, np.eye(3)))
    assert math.isnan(measured_pitch(np.array([0.0, 0.0, 1.0]), np.full((3, 3), bad), np.eye(3)))
