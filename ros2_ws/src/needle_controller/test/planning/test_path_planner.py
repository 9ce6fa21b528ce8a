from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from needle_controller.model.arrays import Array
from needle_controller.planning.legs import move, seen_from
from needle_controller.planning.obstacles import Obstacle, Obstacles
from needle_controller.planning.path_planner import NeedlePath, PathPlanner, TipState
from needle_controller.planning.path_settings import PathSettings
from needle_core.errors import UserError

CURVATURE = 1.0 / 0.122
RATE = math.radians(30.0) / 0.001
TARGET = np.array([0.004, -0.006, 0.1])
MOVED = np.array([0.006, -0.006, 0.1])
NEEDLE = PathSettings(RATE).needle_radius
ENTRY = TipState(np.zeros(3), np.eye(3), CURVATURE)
IN_THE_WAY = Obstacles([Obstacle((0.002, -0.003, 0.05), (0.002, -0.003, 0.05), 0.005)])
BAR = Obstacles([Obstacle((-0.03, -0.002, 0.055), (0.03, -0.002, 0.055), 0.004)])


def planner(**changes: float) -> PathPlanner:
    return PathPlanner(PathSettings(RATE, **changes))


def steered(obstacles: Obstacles, target: Array = TARGET) -> tuple[float, float, list[NeedlePath]]:
    """Return miss, least clearance [m] and the paths of a needle whose pose is known."""
    plans, pose, least, insertion = planner(), ENTRY.pose, math.inf, 0.0
    paths: list[NeedlePath] = []
    while True:
        tip = TipState(pose[:, 3], pose[:, :3], CURVATURE)
        followed = paths[-1] if paths else None
        path = plans.path(tip, target, obstacles, insertion=insertion, followed=followed)
        assert path is not None
        paths.append(path)
        ahead = seen_from(pose, target)[2]
        if ahead <= 1e-5:
            return float(np.linalg.norm(pose[:, 3] - target)), least, paths
        length = min(0.001, ahead)
        x, y, _ = seen_from(pose, path.aim)
        turn = min(max(math.atan2(x, -y), -RATE * length), RATE * length)
        for _ in range(4):
            move(pose, length / 4, turn / 4, CURVATURE, pose)
            least = min(least, obstacles.clearance(pose[:, 3]) - NEEDLE)
        insertion += length


def test_without_obstacles_the_path_is_one_leg_to_the_target() -> None:
    path = planner().path(ENTRY, TARGET, Obstacles())
    assert path is not None
    assert path.legs.shape == (1, 4)
    np.testing.assert_allclose(path.aim, TARGET)
    assert path.margin == math.inf
    assert path.length == pytest.approx(np.linalg.norm(TARGET), rel=0.01)


@pytest.mark.parametrize("obstacles", [IN_THE_WAY, BAR])
def test_the_needle_is_led_past_what_is_in_the_way(obstacles: Obstacles) -> None:
    miss, least, paths = steered(obstacles)
    assert len(paths[0].legs) > 1
    assert miss < 5e-4
    assert least > 0.0
    # It does not change its mind with every step.
    assert sum(len(b.legs) != len(a.legs) for a, b in itertools.pairwise(paths)) <= 4


def test_the_same_question_has_the_same_answer() -> None:
    first, second = (planner().path(ENTRY, TARGET, IN_THE_WAY) for _ in range(2))
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.legs, second.legs)


def test_a_wall_across_the_way_leaves_no_path() -> None:
    rows = [
        Obstacle((-0.05, y, 0.05), (0.05, y, 0.05), 0.005) for y in np.arange(-0.06, 0.061, 0.008)
    ]
    assert planner().path(ENTRY, TARGET, Obstacles(rows)) is None


def test_what_bends_too_little_or_is_too_short_has_no_path() -> None:
    aside = np.array([0.03, 0.0, 0.06])
    assert planner().path(ENTRY, aside, Obstacles()) is None
    assert planner(longest=0.09).path(ENTRY, TARGET, Obstacles()) is None
    assert planner(longest=0.12).path(ENTRY, TARGET, Obstacles()) is not None
    assert planner(longest=0.12).path(ENTRY, TARGET, Obstacles(), insertion=0.03) is None


def test_what_is_unknown_widens_what_must_be_clear() -> None:
    near = Obstacles([Obstacle((0.0, 0.004, 0.02), (0.0, 0.004, 0.02), 0.003)])
    straight = np.array([0.0, 0.0, 0.09])
    # The needle bends to -y before it is turned: away from the sphere.
    known = planner().path(ENTRY, straight, near)
    unsure = TipState(np.zeros(3), np.eye(3), CURVATURE, 0.0003, math.radians(3.0))
    assert known is not None
    margins = [known.margin]
    doubted = planner().path(unsure, straight, near)
    margins.append(-1.0 if doubted is None else doubted.margin)
    assert margins[1] < margins[0]


def test_the_followed_path_goes_on_from_where_the_needle_is() -> None:
    path = planner().path(ENTRY, TARGET, IN_THE_WAY)
    assert path is not None
    first = float(path.legs[0, 3])
    left = path.rest(0.5 * first)
    assert left[0, 3] == pytest.approx(0.5 * first)
    np.testing.assert_array_equal(left[:, :3], path.legs[:, :3])
    np.testing.assert_array_equal(path.rest(first)[:, :3], path.legs[1:, :3])
    np.testing.assert_array_equal(path.rest(1.0)[:, :3], path.legs[-1:, :3])


def test_a_path_that_runs_into_a_new_obstacle_is_left() -> None:
    plans = planner()
    path = plans.path(ENTRY, TARGET, Obstacles())
    again = plans.path(ENTRY, TARGET, IN_THE_WAY, followed=path)
    assert again is not None
    assert again.margin >= 0.0
    assert len(again.legs) > 1
    buried = Obstacles([Obstacle((0.0, 0.0, 0.005), (0.0, 0.0, 0.005), 0.004)])
    assert plans.path(ENTRY, TARGET, buried, followed=path) is None


def test_a_target_that_moves_is_followed() -> None:
    plans = planner()
    path = plans.path(ENTRY, TARGET, IN_THE_WAY)
    moved = plans.path(ENTRY, MOVED, IN_THE_WAY, followed=path)
    assert moved is not None
    np.testing.assert_allclose(moved.legs[-1, :3], MOVED)


def test_bad_calls_are_refused_with_the_value() -> None:
    with pytest.raises(UserError, match="sigmas = -1"):
        planner(sigmas=-1.0)
    bent = TipState(np.zeros(3), np.eye(3), math.nan)
    with pytest.raises(UserError, match="curvature = nan"):
        planner().path(bent, TARGET, Obstacles())
