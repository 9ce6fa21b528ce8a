from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize

from needle_controller.model.arrays import Array
from needle_controller.planning.obstacle_files import read_obstacles
from needle_controller.planning.obstacles import MOST_OBSTACLES, Obstacle, Obstacles
from needle_controller.planning.segments import segment_distance
from needle_core.errors import UserError

SPHERE = Obstacle((0.0, 0.0, 0.05), (0.0, 0.0, 0.05), 0.004)


def test_the_distance_of_segments_is_the_least_of_any_two_of_their_points() -> None:
    rng = np.random.default_rng(3)
    for _ in range(60):
        a, b, c, d = rng.normal(size=(4, 3))
        d = c if rng.random() < 0.2 else d
        b = a + (d - c) * rng.normal() if rng.random() < 0.2 else b

        def apart(at: Array, a: Array = a, b: Array = b, c: Array = c, d: Array = d) -> float:
            return float(np.sum((a + at[0] * (b - a) - c - at[1] * (d - c)) ** 2))

        best = min(
            minimize(apart, start, bounds=[(0, 1), (0, 1)], tol=1e-14).fun
            for start in ((0.5, 0.5), (0.0, 1.0), (1.0, 0.0))
        )
        assert segment_distance(a, b, c, d) == pytest.approx(math.sqrt(best), abs=1e-4)


def test_clearance_is_from_the_surface_of_the_nearest() -> None:
    capsule = Obstacle((0.0, -0.01, 0.08), (0.0, 0.01, 0.08), 0.003)
    obstacles = Obstacles([SPHERE, capsule])
    assert obstacles.clearance([0.01, 0.0, 0.05]) == pytest.approx(0.006)
    assert obstacles.clearance([0.0, 0.02, 0.08]) == pytest.approx(0.007)
    assert obstacles.clearance([0.0, 0.005, 0.08]) == pytest.approx(-0.003)
    assert Obstacles().clearance([0.0, 0.0, 0.0]) == math.inf


@pytest.mark.parametrize(
    ("obstacles", "words"),
    [
        ([Obstacle((0.0, math.nan, 0.0), (0.0, 0.0, 0.0), 0.01)], "y of obstacle 1 = nan"),
        ([SPHERE, Obstacle((0.0, 0.0, 50.0), (0.0, 0.0, 50.0), 0.01)], "z of obstacle 2 = 50 m"),
        ([Obstacle((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)], "radius of obstacle 1 = 0 m"),
        ([SPHERE] * (MOST_OBSTACLES + 1), "65 obstacles"),
    ],
)
def test_what_is_no_obstacle_is_refused_by_name(obstacles: list[Obstacle], words: str) -> None:
    with pytest.raises(UserError, match=words):
        Obstacles(obstacles)


GOOD = """
frame: rig
spheres:
  - {center: [0.0, 0.002, 0.05], radius: 0.004}
capsules:
  - {start: [-0.02, 0.0, 0.07], end: [0.02, 0, 0.07], radius: 0.003}
"""


def test_a_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "obstacles.yaml"
    path.write_text(GOOD, encoding="utf-8")
    np.testing.assert_allclose(
        read_obstacles(path).table,
        [[0.0, 0.002, 0.05, 0.0, 0.002, 0.05, 0.004], [-0.02, 0.0, 0.07, 0.02, 0.0, 0.07, 0.003]],
    )


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("frame: rig", "frame: world", "frame 'world', wants 'rig'"),
        ("spheres:", "cubes:", "cubes is not one of"),
        ("radius: 0.004", "size: 0.004", "spheres, number 1: wants center, radius"),
        ("0.002, 0.05", ".nan, 0.05", "y of obstacle 1 = nan"),
        ("[0.0, 0.002, 0.05]", "[0.0, 0.05]", "center = .* wants three numbers"),
        ("radius: 0.003", "radius: '3 mm'", "capsules, number 1: radius = '3 mm'"),
        ("frame: rig", "frame: [", "not YAML in line 4"),
        ("spheres:", "spheres: 3\nboxes:", "boxes is not one of"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path: Path, old: str, new: str, words: str) -> None:
    path = tmp_path / "obstacles.yaml"
    path.write_text(GOOD.replace(old, new), encoding="utf-8")
    with pytest.raises(UserError, match=words) as error:
        read_obstacles(path)
    assert "\n" not in str(error.value)


def test_a_file_that_is_missing_is_said(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"no\.yaml: cannot be read"):
        read_obstacles(tmp_path / "no.yaml")
