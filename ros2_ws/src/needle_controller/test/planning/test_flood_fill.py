"""Proof that no path exists, by the flood fill."""

from __future__ import annotations

import math

import numpy as np
import pytest

from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import rotation_from_angles
from needle_controller.planning import path_planner
from needle_controller.planning.obstacles import Obstacle, Obstacles
from needle_controller.planning.path_evaluation import PathSettings
from needle_controller.planning.path_planner import NeedlePath, PathPlanner, TipState

from .scenes import random_obstacles

CURVATURE = 1.0 / 0.1356
SETTINGS = PathSettings(math.radians(30.0) / 0.001, curvature_share=1.0, gentle_share=1.0)
PLANNER = PathPlanner(SETTINGS)
ENTRY = TipState(np.zeros(3), np.eye(3), CURVATURE)
TARGET = np.array([0.0, 0.0, 0.1])
RADIUS = 0.003


def wall(gap: float, middle: float = 0.0, depth: float = 0.05) -> Obstacles:
    """A wall of rods with a gap between two of them, whose middle is displaced in x [m]."""
    places = np.arange(0.5 * gap + RADIUS, 0.07, RADIUS)
    rods = [middle + sign * place for sign in (-1.0, 1.0) for place in places]
    return Obstacles([Obstacle((x, -0.08, depth), (x, 0.08, depth), RADIUS) for x in rods])


def may(obstacles: Obstacles, tip: TipState = ENTRY, target: Array = TARGET) -> bool:
    return PLANNER.may_have_path(tip, target, obstacles)


@pytest.fixture(scope="module", autouse=True)
def _loaded() -> None:
    """Load compiled code once, outside the tests."""
    may(Obstacles())


@pytest.fixture
def _no_hint(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip the search for another entry, which takes seconds at a wall of rods."""
    monkeypatch.setattr(PathPlanner, "nearest_entry", lambda *_: None)


@pytest.mark.usefixtures("_no_hint")
def test_a_wall_with_a_gap_has_a_path_and_one_without_has_none() -> None:
    clear = 2.0 * SETTINGS.least_clearance
    assert may(Obstacles())
    assert may(wall(clear + 0.001))
    # The resolution of the fill is a cell and 0.1 mm of bending.
    assert not may(wall(clear - 0.0015))
    found = PLANNER.first_path(ENTRY, TARGET, wall(clear - 0.0015))
    assert isinstance(found, str)
    assert "no path to the target point is clear of the" in found


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_gap_counts_only_within_reach_of_needle_and_target(sign: float) -> None:
    # Within 50 mm a needle can move 9.2 mm aside and return, or 9.6 mm without returning.
    assert may(wall(0.004, sign * 0.004))
    assert not may(wall(0.004, sign * 0.014))
    aside = np.array([sign * 0.025, 0.0, 0.1])
    assert may(wall(0.004, sign * 0.008), target=aside)
    assert not may(wall(0.004, -sign * 0.004), target=aside)


def test_curvature_and_tolerance_bound_the_reachable_targets() -> None:
    # Lateral position of the circle of the largest curvature, 0.1 m ahead.
    radius = 1.0 / CURVATURE
    aside = radius - math.sqrt(radius**2 - 0.1**2)
    for beyond, reached in ((0.0005, True), (0.0030, False)):
        turned = rotation_from_angles([0.2, -0.3, 1.0])
        target = turned @ [0.6 * (aside + beyond), 0.8 * (aside + beyond), 0.1]
        tip = TipState(np.array([0.01, 0.02, 0.0]), turned, CURVATURE)
        assert may(Obstacles(), tip, tip.position + target) is reached
    assert not may(Obstacles(), target=np.array([0.0, 0.0, -0.01]))


def test_the_flood_fill_never_excludes_an_existing_path() -> None:
    paths = 0
    for seed in range(16):
        rng = np.random.default_rng([5, seed])
        obstacles = random_obstacles(rng, 5, 0.008)
        target = np.array([*rng.uniform(-0.02, 0.02, 2), 0.09])
        if PLANNER.path(ENTRY, target, obstacles) is not None:
            paths += 1
            assert may(obstacles, target=target)
    assert 3 < paths < 13


@pytest.mark.usefixtures("_no_hint")
def test_a_failed_search_is_not_reported_as_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    # Wide enough for the resolution of the fill, too narrow for a needle.
    narrow = wall(2.0 * SETTINGS.least_clearance - 0.0003)
    monkeypatch.setattr(path_planner, "THOROUGH_STARTS", 5)
    found = PLANNER.first_path(ENTRY, TARGET, narrow)
    assert isinstance(found, str)
    assert "was found clear of the" in found


def test_the_thorough_search_finds_more_than_the_quick_one() -> None:
    # Scene 182 of the obstacle study of seed 909.
    rows = [
        (-0.00113, 0.01008, 0.07275, 0.01968, 0.00163, 0.04861, 0.00685),
        (-0.00363, -0.00664, 0.0533, 0.02809, 0.00195, 0.03646, 0.0049),
        (0.01364, 0.01014, 0.03855, 0.00344, 0.00708, 0.04418, 0.00851),
    ]
    target = [0.00404, -0.00454, 0.08293]
    obstacles = Obstacles([Obstacle(row[:3], row[3:6], row[6]) for row in rows])
    assert PLANNER.path(ENTRY, target, obstacles) is None
    found = PLANNER.first_path(ENTRY, target, obstacles)
    assert isinstance(found, NeedlePath)
    assert found.evaluation.margin >= 0.0
