from __future__ import annotations

import math

import numpy as np
import pytest

from needle_controller.planning.obstacles import Obstacle, Obstacles
from needle_controller.planning.path_planner import PathPlanner
from needle_controller.planning.path_settings import PathSettings
from needle_controller.planning.safe_starts import SafeStarts, safe_starts

CURVATURE = 1.0 / 0.122
RATE = math.radians(30.0) / 0.001
OFFSETS = np.array([-0.03, -0.01, 0.0, 0.01, 0.03])
ANGLES = np.radians([-30.0, -5.0, 0.0, 5.0, 30.0])


def starts_of(obstacles: Obstacles, depth: float = 0.1) -> SafeStarts:
    return safe_starts(
        PathPlanner(PathSettings(RATE)),
        [0.0, 0.0, depth],
        obstacles,
        CURVATURE,
        offsets=OFFSETS,
        angles=ANGLES,
    )


def test_without_obstacles_the_bend_says_how_far_off_a_start_may_be() -> None:
    starts = starts_of(Obstacles())
    # At 0.1 m a needle of 90 % of this curvature gets about 45 mm aside, less while it turns;
    # tilted by 30 deg the target lies 50 mm aside of 87 mm ahead.
    assert np.all(starts.shifted)
    assert np.all(starts.tilted[1:4, 1:4])
    assert not np.any(starts.tilted[0, :])
    assert not np.any(starts.tilted[:, 4])
    assert starts.largest_shift == pytest.approx(0.03)
    assert math.degrees(starts.largest_tilt) == pytest.approx(5.0 * math.sqrt(2.0))


def test_an_axis_is_x_first_and_an_obstacle_shades_its_side() -> None:
    # Beside the entry in +x, from the surface to near the target.
    beside = Obstacles([Obstacle((0.03, -0.05, 0.01), (0.03, 0.05, 0.01), 0.008)])
    starts = starts_of(beside)
    assert not np.any(starts.shifted[4, :])
    assert np.all(starts.shifted[:3, :])
    assert starts.largest_shift < 0.03


def test_where_not_even_the_entry_is_safe_nothing_is() -> None:
    at_entry = Obstacles([Obstacle((0.0, 0.0, 0.005), (0.0, 0.0, 0.005), 0.004)])
    starts = starts_of(at_entry)
    assert not starts.shifted[2, 2]
    assert starts.largest_shift == 0.0
    assert starts.largest_tilt == 0.0
