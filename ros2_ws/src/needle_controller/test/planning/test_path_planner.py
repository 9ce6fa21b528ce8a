"""Paths past obstacles: targets, clearance, rejections, safe starts.

Paths are simulated with scipy's exponential, and their clearance is sampled densely.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from exact_needle import moved
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import rotation_from_angles
from needle_controller.planning.legs import leg_towards, truncated
from needle_controller.planning.obstacles import Obstacle, Obstacles
from needle_controller.planning.path_evaluation import PathSettings
from needle_controller.planning.path_planner import NeedlePath, PathPlanner, TipState

from .scenes import random_obstacles

CURVATURE = 1.0 / 0.122
RATE = math.radians(30.0) / 0.001
TARGET = np.array([0.004, -0.006, 0.1])
ENTRY = TipState(np.zeros(3), np.eye(3), CURVATURE)
IN_THE_WAY = Obstacles([Obstacle((0.002, -0.003, 0.05), (0.002, -0.003, 0.05), 0.005)])
BURIED = Obstacles([Obstacle((0.0, 0.0, 0.005), (0.0, 0.0, 0.005), 0.004)])


def planner(**changes: float) -> PathPlanner:
    return PathPlanner(PathSettings(RATE, **changes))


def found(path: NeedlePath | None) -> NeedlePath:
    assert path is not None
    return path


def driven(tip: TipState, path: NeedlePath, curvature: float) -> Array:
    """Return positions of a needle simulated along a path, 0.25 mm apart, shape (N, 3)."""
    pose = np.vstack([tip.pose, [0.0, 0.0, 0.0, 1.0]])
    places = [pose[:3, 3]]
    for row in path.legs:
        leg = truncated(leg_towards(pose[:3], row[:3], curvature, 1.0, RATE), row[3])
        # With less than the full curvature, the bevel alternates: this is the mean path.
        assert leg.curvature < curvature or abs(leg.turn) <= RATE * leg.turning + 1e-9
        assert leg.curvature <= curvature
        for length, turn, kappa in (
            (leg.turning, leg.turn, curvature),
            (leg.bend, 0.0, leg.curvature),
            (leg.straight, 0.0, 0.0),
        ):
            pieces = max(math.ceil(length / 0.00025), 1)
            piece = moved(np.eye(4), length / pieces, turn / pieces, kappa)
            for _ in range(pieces):
                pose = pose @ piece
                places.append(pose[:3, 3])
    return np.array(places)


def sampled_clearance(places: Array, obstacles: Obstacles) -> float:
    """Return the least distance of positions from samples of the capsules' axes, less the radii."""
    shares = np.linspace(0.0, 1.0, 201)[:, np.newaxis]
    least = math.inf
    for row in obstacles.table:
        axis = row[:3] + shares * (row[3:6] - row[:3])
        least = min(least, float(cdist(places, axis).min()) - row[6])
    return least


def test_a_simulated_path_is_clear_and_ends_within_the_tolerance() -> None:
    settings = PathSettings(RATE, curvature_share=0.9, gentle_share=0.9)
    plans, paths = PathPlanner(settings), 0
    for seed in range(30):
        rng = np.random.default_rng([8, seed])
        turned = rotation_from_angles(rng.uniform([-0.1, -0.1, -3.0], [0.1, 0.1, 3.0]))
        tip = TipState(rng.uniform(-0.005, 0.005, 3), turned, CURVATURE)
        target = np.array([*rng.uniform(-0.025, 0.025, 2), 0.09])
        obstacles = random_obstacles(rng, 4, 0.007)
        path = plans.path(tip, target, obstacles)
        if path is None:
            continue
        paths += len(path.legs) > 1
        places = driven(tip, path, 0.9 * CURVATURE)
        length = float(np.sum(np.linalg.norm(np.diff(places, axis=0), axis=1)))
        assert path.evaluation.length == pytest.approx(length, rel=1e-3)
        assert np.linalg.norm(places[-1] - target) <= settings.goal_tolerance + 1e-4
        # Chords of 5 mm are up to 0.03 mm off their arcs.
        clear = sampled_clearance(places, obstacles) - settings.least_clearance
        assert clear >= -3e-5
        assert path.evaluation.margin == pytest.approx(clear, abs=6e-5)
    assert paths > 5


def test_the_goal_tolerance_limits_the_distance_from_the_target() -> None:
    # Less than 1 mm within the circle of 90 % of the curvature after the turn of the bevel.
    radius = 1.0 / (0.9 * CURVATURE)
    inner = radius - 0.0006
    target = np.array([0.0, inner * math.cos(0.7) - radius, inner * math.sin(0.7)])
    for tolerance, is_found in ((0.001, True), (0.0004, False)):
        path = planner(goal_tolerance=tolerance).path(ENTRY, target, Obstacles())
        assert (path is not None) is is_found
        if path is not None:
            end = driven(ENTRY, path, 0.9 * CURVATURE)[-1]
            assert np.linalg.norm(end - target) == pytest.approx(0.0006, abs=2e-5)


def test_walls_stiff_needles_and_short_needles_have_no_path() -> None:
    rows = [
        Obstacle((-0.05, y, 0.05), (0.05, y, 0.05), 0.005) for y in np.arange(-0.06, 0.061, 0.008)
    ]
    assert planner().path(ENTRY, TARGET, Obstacles(rows)) is None
    assert planner().path(ENTRY, np.array([0.03, 0.0, 0.06]), Obstacles()) is None
    assert planner(longest=0.09).path(ENTRY, TARGET, Obstacles()) is None
    found(planner(longest=0.12).path(ENTRY, TARGET, Obstacles()))
    assert planner(longest=0.12).path(ENTRY, TARGET, Obstacles(), insertion=0.03) is None


def test_uncertainty_increases_the_required_clearance() -> None:
    near = Obstacles([Obstacle((0.0, 0.004, 0.02), (0.0, 0.004, 0.02), 0.003)])
    straight = np.array([0.0, 0.0, 0.09])
    # Before the turn the needle bends to -y, away from the sphere.
    known = found(planner().path(ENTRY, straight, near))
    unsure = TipState(np.zeros(3), np.eye(3), CURVATURE, 0.0003, math.radians(3.0))
    doubted = planner().path(unsure, straight, near)
    assert (-1.0 if doubted is None else doubted.evaluation.margin) < known.evaluation.margin


def test_the_previous_path_continues_unless_it_is_blocked() -> None:
    plans = planner()
    path = found(plans.path(ENTRY, TARGET, IN_THE_WAY))
    first = float(path.legs[0, 3])
    left = path.remaining_legs(0.5 * first)
    assert left[0, 3] == pytest.approx(0.5 * first)
    np.testing.assert_array_equal(left[:, :3], path.legs[:, :3])
    np.testing.assert_array_equal(path.remaining_legs(first)[:, :3], path.legs[1:, :3])
    np.testing.assert_array_equal(path.remaining_legs(1.0)[:, :3], path.legs[-1:, :3])
    # The path follows a moving target.
    near = TARGET + np.array([0.002, 0.0, 0.0])
    again = found(plans.path(ENTRY, near, IN_THE_WAY, previous=path))
    np.testing.assert_allclose(again.legs[-1, :3], near)
    direct = found(plans.path(ENTRY, TARGET, Obstacles()))
    around = found(plans.path(ENTRY, TARGET, IN_THE_WAY, previous=direct))
    assert around.evaluation.margin >= 0.0
    assert len(around.legs) > 1
    assert plans.path(ENTRY, TARGET, BURIED, previous=direct) is None


def test_the_trace_ends_where_the_path_does_with_either_curvature() -> None:
    plans = planner()
    easy, far = np.array([0.02, 0.0, 0.1]), np.array([0.047, 0.0, 0.1])
    path = found(plans.path(ENTRY, easy, Obstacles()))
    assert path.legs.shape == (1, 4)
    assert np.linalg.norm(plans.trace(path, ENTRY)[-1] - easy) < 1e-3
    # Only a needle that is already inserted may use its whole curvature.
    assert plans.path(ENTRY, far, Obstacles()) is None
    path = found(plans.path(ENTRY, far, Obstacles(), previous=path))
    assert np.linalg.norm(plans.trace(path, ENTRY)[-1] - far) < 1e-3
