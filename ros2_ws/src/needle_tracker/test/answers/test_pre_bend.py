"""The heading behind the visible end."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_sim.needle.needle_shape import NeedleShape
from needle_tracker.answers.pre_bend import heading_of

LEAN = math.radians(5.6)


@pytest.mark.parametrize("seed", range(2))
def test_the_heading_of_the_drawn_needle_comes_back(seed: int) -> None:
    """Against the renderer's own needle: its last millimetres are what a camera sees."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler(
        "xyz", rng.uniform([-0.3, -0.3, -3], [0.3, 0.3, 3])
    ).as_matrix()
    behind = pose[:3, 3] - np.outer(np.linspace(0.05, 0.0, 101), pose[:3, 2])
    line = NeedleShape().middle_line(pose, behind, 1e-4)
    direction = (line[-1] - line[-60]) / np.linalg.norm(line[-1] - line[-60])
    assert direction @ pose[:3, 2] < math.cos(math.radians(5.0))
    # The estimate's heading is off; its roll is right.
    off = Rotation.from_rotvec(pose[:3, :3] @ [0.05, -0.04, 0.0]).as_matrix()
    heading, covariance = heading_of(direction, np.zeros((3, 3)), off @ pose[:3, :3], 0.1, LEAN)
    np.testing.assert_allclose(heading, pose[:3, 2], atol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(heading), 1.0)
    spread = np.sqrt(np.linalg.eigvalsh(covariance)[-1])
    np.testing.assert_allclose(spread, 0.1 * math.sin(LEAN), rtol=1e-6)


def test_a_wrong_roll_is_off_by_what_the_covariance_says() -> None:
    direction = np.array([0.0, -math.sin(LEAN), math.cos(LEAN)])
    for roll in (-0.2, 0.1, 0.2):
        turned = Rotation.from_euler("z", roll).as_matrix()
        heading, _ = heading_of(direction, np.zeros((3, 3)), turned, 0.0, LEAN)
        np.testing.assert_allclose(abs(heading[0]), abs(roll) * math.sin(LEAN), rtol=0.05)


def test_without_lean_nothing_changes() -> None:
    direction = np.array([0.1, 0.2, math.sqrt(0.95)])
    heading, covariance = heading_of(direction, np.eye(3) * 1e-4, np.eye(3), 1.0, 0.0)
    np.testing.assert_allclose(heading, direction)
    np.testing.assert_array_equal(covariance, np.eye(3) * 1e-4)
