"""The whole shaft in space from its paths in two images."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_tracker.detector.end_search import ShaftPath
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.stereo.sighting import is_reachable, shaft_length, shaft_points
from needle_tracker.tracker_parameters import StereoTrackerParameters

Views = tuple[RefractedCamera, RefractedCamera]
LENGTH = 70e-3
HOLE = 4e-3


def arc(curvature: float, roll: float, *, start: float = HOLE, count: int = 130) -> np.ndarray:
    """Return points along an arc from the entry, bending in the plane turned by `roll` about z."""
    s = np.linspace(start, LENGTH, count)
    radius = 1.0 / curvature
    flat = np.stack([radius * (1.0 - np.cos(s / radius)), 0.0 * s, radius * np.sin(s / radius)], 1)
    return np.asarray(Rotation.from_euler("z", roll).apply(flat))


def seen(view: RefractedCamera, points: np.ndarray) -> ShaftPath:
    return ShaftPath(view.project(points), 30.0, 1.0)


def distance_to(points: np.ndarray, curve: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(points[:, None] - curve[None], axis=-1).min(axis=1))


@pytest.mark.parametrize("roll", [0.0, 0.7, 1.6, 3.0, -1.2])
@pytest.mark.parametrize("curvature", [2.0, 7.0])
def test_shaft_points_are_on_the_shaft(views: Views, curvature: float, roll: float) -> None:
    points = arc(curvature, roll)
    # The right path starts elsewhere and has other points.
    paths = (seen(views[0], points), seen(views[1], arc(curvature, roll, start=5e-3, count=171)))
    found = shaft_points(views, paths, points[-1])
    assert len(found) >= 9
    np.testing.assert_array_equal(found[-1], points[-1])
    fine = arc(curvature, roll, count=20_001)
    assert distance_to(found, fine).max() < 0.05e-3
    assert np.all(np.diff(found[:, 2]) > 0.0)


@pytest.mark.parametrize("roll", [0.0, 1.6])
def test_the_steps_of_the_cells_are_smoothed(views: Views, roll: float) -> None:
    points = arc(4.0, roll)
    rng = np.random.default_rng(0)
    paths = tuple(
        ShaftPath(p.pixels + rng.uniform(-1.5, 1.5, p.pixels.shape), 30.0, 1.0)
        for p in (seen(view, points) for view in views)
    )
    found = shaft_points(views, (paths[0], paths[1]), points[-1])
    # 1.5 px are 0.2 mm; seven cells together leave less of that, the cameras' depth makes it more.
    assert distance_to(found, arc(4.0, roll, count=20_001)).max() < 1e-3


def test_a_needle_is_reachable_and_its_length_is_right(
    views: Views, settings: StereoTrackerParameters
) -> None:
    points = arc(5.0, 1.0)
    found = shaft_points(views, (seen(views[0], points), seen(views[1], points)), points[-1])
    assert is_reachable(found, settings)
    assert shaft_length(found) == pytest.approx(LENGTH, abs=0.05e-3)


def test_a_shadow_on_the_floor_is_not_reachable(
    views: Views, settings: StereoTrackerParameters
) -> None:
    shadow = arc(5.0, 1.0)
    shadow[:, 0] = -20e-3
    found = shaft_points(views, (seen(views[0], shadow), seen(views[1], shadow)), shadow[-1])
    assert distance_to(found, shadow).max() < 0.3e-3
    assert not is_reachable(found, settings)


def test_a_line_along_the_baseline_has_no_shaft_points(views: Views) -> None:
    y = np.linspace(-20e-3, 20e-3, 130)
    line = np.stack([0.0 * y, y, np.full_like(y, 62.5e-3)], axis=1)
    # Every ray of one image meets all of the other's there, and a hair's breadth says where.
    found = shaft_points(views, (seen(views[0], line), seen(views[1], line)), line[-1])
    np.testing.assert_array_equal(found, line[-1:])


def test_lines_that_do_not_meet_leave_the_tip_alone(views: Views) -> None:
    points = arc(5.0, 0.0)
    other = points + np.array([0.0, 30e-3, 0.0])
    found = shaft_points(views, (seen(views[0], points), seen(views[1], other)), points[-1])
    np.testing.assert_array_equal(found[-1], points[-1])
    assert len(found) == 1 or distance_to(found[:-1], points).min() > 1e-3
