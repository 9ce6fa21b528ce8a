"""Obstacles: distances against least squares; files, messages and settings."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from needle_controller.planning.obstacles import (
    CYLINDER,
    MOST_OBSTACLES,
    SPHERE,
    Obstacle,
    Obstacles,
    obstacles_from_markers,
    read_obstacles,
    segment_distance,
)
from needle_core.errors import UserError
from needle_core.messages import Marker, Markers

ROUND = Obstacle((0.0, 0.0, 0.05), (0.0, 0.0, 0.05), 0.004)
STRAIGHT = (0.0, 0.0, 0.0, 1.0)
CUBE, DELETEALL = 1, 3
BALL = Marker("rig", "bone", 4, SPHERE, 0, (0.01, -0.02, 0.05), STRAIGHT, (0.006, 0.006, 0.006))
FILE = """
frame: rig
spheres:
  - {center: [0.0, 0.002, 0.05], radius: 0.004}
capsules:
  - {start: [-0.02, 0.0, 0.07], end: [0.02, 0, 0.07], radius: 0.003}
"""


def test_segment_distance_is_the_least_distance_of_points() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        a, b, c, d = rng.normal(size=(4, 3))
        d = c if rng.random() < 0.2 else d
        b = a + (d - c) * rng.normal() if rng.random() < 0.2 else b
        at = lsq_linear(np.stack([b - a, c - d], axis=1), c - a, bounds=(0.0, 1.0)).x
        least = np.linalg.norm(a + at[0] * (b - a) - c - at[1] * (d - c))
        assert segment_distance(a, b, c, d) == pytest.approx(least, abs=1e-6)


def test_clearance_is_from_the_surface_of_the_nearest() -> None:
    obstacles = Obstacles([ROUND, Obstacle((0.0, -0.01, 0.08), (0.0, 0.01, 0.08), 0.003)])
    assert obstacles.clearance([0.01, 0.0, 0.05]) == pytest.approx(0.006)
    assert obstacles.clearance([0.0, 0.02, 0.08]) == pytest.approx(0.007)
    assert obstacles.clearance([0.0, 0.005, 0.08]) == pytest.approx(-0.003)
    assert Obstacles().clearance([0.0, 0.0, 0.0]) == math.inf


def test_invalid_obstacles_are_rejected_by_number() -> None:
    for obstacles, words in (
        ([Obstacle((0.0, math.nan, 0.0), (0.0, 0.0, 0.0), 0.01)], "y of obstacle 1 = nan"),
        ([ROUND, Obstacle((0.0, 0.0, 50.0), (0.0, 0.0, 50.0), 0.01)], "z of obstacle 2 = 50 m"),
        ([Obstacle((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)], "radius of obstacle 1 = 0 m"),
        ([ROUND] * (MOST_OBSTACLES + 1), "65 obstacles"),
    ):
        with pytest.raises(UserError, match=words):
            Obstacles(obstacles)


def test_a_file_is_read_or_rejected_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "obstacles.yaml"
    path.write_text(FILE, encoding="utf-8")
    np.testing.assert_allclose(
        read_obstacles(path).table,
        [[0.0, 0.002, 0.05, 0.0, 0.002, 0.05, 0.004], [-0.02, 0.0, 0.07, 0.02, 0.0, 0.07, 0.003]],
    )
    for old, new, words in (
        ("frame: rig", "frame: world", "frame 'world', expected 'rig'"),
        ("spheres:", "cubes:", "cubes is not one of"),
        ("radius: 0.004", "size: 0.004", "spheres, number 1: expected center, radius"),
        ("[0.0, 0.002, 0.05]", "[0.0, 0.05]", "center = .* expected three numbers"),
        ("radius: 0.003", "radius: '3 mm'", "capsules, number 1: radius = '3 mm'"),
        ("frame: rig", "frame: [", "not YAML in line 4"),
        (FILE, "- 3", "expected"),
    ):
        path.write_text(FILE.replace(old, new), encoding="utf-8")
        with pytest.raises(UserError, match=words) as error:
            read_obstacles(path)
        assert "\n" not in str(error.value)
    with pytest.raises(UserError, match=r"no\.yaml: cannot be read"):
        read_obstacles(tmp_path / "no.yaml")


def test_markers_become_capsules_or_are_rejected_by_name() -> None:
    half = math.sqrt(0.5)
    # A quarter turn about x takes z to -y.
    lying = dataclasses.replace(
        BALL, kind=CYLINDER, orientation=(half, 0.0, 0.0, half), scale=(0.004, 0.004, 0.03)
    )
    deleting = dataclasses.replace(BALL, action=DELETEALL, frame_id="")
    expected = [
        [0.01, -0.02, 0.05, 0.01, -0.02, 0.05, 0.003],
        [0.01, -0.005, 0.05, 0.01, -0.035, 0.05, 0.002],
    ]
    found = obstacles_from_markers(Markers((deleting, BALL, lying)))
    np.testing.assert_allclose(found.table, expected, atol=1e-12)
    rows: list[tuple[dict[str, Any], str]] = [
        ({"frame_id": "map"}, r"obstacle 1 \('bone' 4\) is given in frame 'map', expected 'rig'"),
        ({"kind": CUBE}, "of type 1, expected SPHERE"),
        ({"scale": (0.006, 0.01, 0.006)}, "is not round"),
        ({"position": (0.01, -0.02, math.nan)}, "is not finite"),
        ({"kind": CYLINDER, "orientation": (0.0, 0.0, 0.0, 0.0)}, "quaternion has length 0"),
    ]
    for spoilt, words in rows:
        with pytest.raises(UserError, match=words):
            obstacles_from_markers(Markers((dataclasses.replace(BALL, **spoilt),)))
