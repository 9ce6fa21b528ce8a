"""Pairs of ends, and the whole shaft in space from its paths in two images."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import drawn_needles
from needle_tracker.detector.end_fit import ImageEnd
from needle_tracker.detector.end_search import ShaftPath
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.stereo.sighting import (
    StereoSearch,
    evidence,
    shaft_points,
)
from needle_tracker.stereo.triangulation import triangulate
from needle_tracker.tracker_parameters import StereoTrackerParameters

Views = tuple[RefractedCamera, RefractedCamera]
Search = Callable[..., StereoSearch]


@dataclasses.dataclass
class SeenLines:
    """Stand-in for a detector: the lines in a camera's view, each from the entry to its end."""

    view: RefractedCamera
    lines: list[np.ndarray]
    ends: float = 0.95

    def search(self, least: float, most: float) -> list[ShaftPath]:
        return [ShaftPath(self.view.project(line), 10.0, 0.9) for line in self.lines]

    def ends_near(self, path: ShaftPath, *, hidden: bool) -> list[ImageEnd]:
        return [ImageEnd(path.end, path.direction, 0.2, 1.0, 0.01, self.ends, 0.9)]

    def trace(self, path: ShaftPath, end: ImageEnd) -> ShaftPath:
        return path


@pytest.fixture
def search(views: Views, settings: StereoTrackerParameters) -> Search:
    def make(left: list[np.ndarray], right: list[np.ndarray]) -> StereoSearch:
        detectors = SeenLines(views[0], left), SeenLines(views[1], right)
        return StereoSearch(views, detectors, settings)  # type: ignore[arg-type]

    return make


@pytest.fixture
def needle() -> np.ndarray:
    return drawn_needles.arc(0.06, 6.0, 0.7)


def test_the_end_in_only_one_view_is_reported(search: Search, needle: np.ndarray) -> None:
    sightings, (left, right) = search([needle], []).search(3e-3, 0.15)
    assert sightings == []
    assert left is not None
    assert left.ends > 0.5
    assert right is None


def test_one_needle_in_both_views_is_one_sighting(search: Search, needle: np.ndarray) -> None:
    (sighting,) = search([needle], [needle]).search(3e-3, 0.15)[0]
    np.testing.assert_allclose(sighting.tip.position, needle[-1], atol=0.05e-3)
    assert sighting.length == pytest.approx(0.06, abs=0.2e-3)
    assert sighting.evidence > 4.0


def test_a_line_in_only_one_view_is_no_sighting(search: Search, needle: np.ndarray) -> None:
    line = drawn_needles.arc(0.09, 3.0, -1.5)
    found = search([line, needle], [needle]).search(3e-3, 0.15)[0]
    assert len(found) == 1
    np.testing.assert_allclose(found[0].tip.position, needle[-1], atol=0.05e-3)


def test_a_shadow_on_the_floor_is_no_sighting(search: Search, needle: np.ndarray) -> None:
    shadow = needle * [0.0, 1.0, 1.0] - [0.02, 0.0, 0.0]
    assert search([shadow], [shadow]).search(3e-3, 0.15)[0] == []


def test_a_line_whose_tangent_misses_the_entry_is_no_sighting(
    search: Search, needle: np.ndarray
) -> None:
    beside = needle + np.array([0.0, 0.017, 0.0])
    assert search([beside], [beside]).search(3e-3, 0.15)[0] == []


def test_sightings_are_only_at_the_given_distances(search: Search, needle: np.ndarray) -> None:
    assert search([needle], [needle]).search(0.07, 0.08)[0] == []


def test_evidence_is_the_sum_over_the_views(views: Views, needle: np.ndarray) -> None:
    left, right = (
        SeenLines(view, [needle]).ends_near(
            ShaftPath(view.project(needle), 1.0, 1.0), hidden=False
        )[0]
        for view in views
    )
    tip = triangulate(views, (left, right))
    assert tip is not None
    sure = evidence((left, right), tip)
    doubtful = evidence((left, dataclasses.replace(right, ends=0.05)), tip)
    assert sure == pytest.approx(2.0 * np.log(0.95 / 0.05) - 0.5 * tip.misfit)
    assert doubtful == pytest.approx(-0.5 * tip.misfit, abs=1e-9)
    assert evidence((left, dataclasses.replace(right, ends=1.5)), tip) < 10.0


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
    # The right path starts elsewhere and has different points.
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
    # 1.5 px are 0.2 mm; averaging seven cells reduces that, the depth direction increases it.
    assert distance_to(found, arc(4.0, roll, count=20_001)).max() < 1e-3


def test_a_line_along_the_baseline_has_no_shaft_points(views: Views) -> None:
    y = np.linspace(-20e-3, 20e-3, 130)
    line = np.stack([0.0 * y, y, np.full_like(y, 62.5e-3)], axis=1)
    # There, the rays of both images are coplanar, and their intersection is undetermined.
    found = shaft_points(views, (seen(views[0], line), seen(views[1], line)), line[-1])
    np.testing.assert_array_equal(found, line[-1:])
