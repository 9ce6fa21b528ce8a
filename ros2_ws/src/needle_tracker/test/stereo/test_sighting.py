"""Pairs of ends in two images, and the length of the shaft."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import cv2
import numpy as np
import pytest

import drawn_needles
from needle_tracker.detector.end_fit import ImageEnd
from needle_tracker.detector.search_grid import GridView, SearchGrid, make_search_grid
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.stereo.sighting import StereoSearch, evidence, shaft_length
from needle_tracker.stereo.triangulation import triangulate
from needle_tracker.tracker_parameters import StereoTrackerParameters

Views = tuple[RefractedCamera, RefractedCamera]
Search = Callable[..., StereoSearch]


@dataclasses.dataclass
class DrawnLines:
    """Stand-in for a detector: the lines in a camera's view, each from the entry to its end.

    The search at half size sees no thin lines.
    """

    view: RefractedCamera
    lines: list[np.ndarray]
    are_thin: bool = False
    ends: float = 0.95
    shaft: float = 0.9
    scales: int = 2

    def scores(
        self, grid: SearchGrid, seen: GridView, last_row: int, *, full_size: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        pixels = seen.pixels[: grid.starts[last_row + 1]]
        shaft, ends = np.full(len(pixels), -1.0), np.full(len(pixels), -3.0)
        canvas = np.zeros((self.view.camera.height, self.view.camera.width), np.uint8)
        for line in self.lines if full_size or not self.are_thin else ():
            drawn = self.view.project(line)
            cv2.polylines(canvas, [np.rint(drawn).astype(np.int32)], False, 1, 10)
            ends[np.linalg.norm(pixels - drawn[-1], axis=1) < 5.0] = 6.0
        columns, rows = np.rint(pixels).astype(int).T
        shaft[canvas[rows, columns] > 0] = 1.0
        return shaft.astype(np.float32), ends.astype(np.float32)

    def ends_near(
        self, point: np.ndarray, direction: np.ndarray, *, hidden: bool
    ) -> list[ImageEnd]:
        found = []
        for line in self.lines:
            near, end = self.view.project(line[-10:])[[0, -1]]
            if math.dist(end, point) < 15.0:
                along = (end - near) / math.dist(end, near)
                found.append(ImageEnd(end, along, 0.2, 1.0, 0.01, self.ends, self.shaft))
        return found


@pytest.fixture(scope="module")
def search(views: Views) -> Search:
    settings = StereoTrackerParameters(max_insertion=0.1)
    make_search_grid(views, settings)

    def make(
        left: list[np.ndarray],
        right: list[np.ndarray],
        *,
        are_thin: bool = False,
        ends: float = 0.95,
        shafts: tuple[float, float] = (0.9, 0.9),
    ) -> StereoSearch:
        detectors = tuple(
            DrawnLines(view, lines, are_thin, ends, shaft)
            for view, lines, shaft in zip(views, (left, right), shafts, strict=True)
        )
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


@pytest.mark.parametrize("is_thin", [False, True])
def test_one_needle_in_both_views_is_one_sighting(
    search: Search, needle: np.ndarray, is_thin: bool
) -> None:
    # The left view shows the end twice, nearly at the same place.
    lines = [needle, needle + np.array([0.0, 1e-4, 0.0])]
    (sighting,) = search(lines, [needle], are_thin=is_thin).search(3e-3, 0.15)[0]
    np.testing.assert_allclose(sighting.tip.position, needle[-1], atol=0.05e-3)
    assert sighting.length == pytest.approx(0.06, abs=0.6e-3)
    assert sighting.evidence > 4.0


def test_one_view_may_hide_the_shaft_but_not_both(search: Search, needle: np.ndarray) -> None:
    for shafts, count in (((0.3, 0.9), 1), ((0.3, 0.3), 0)):
        found = search([needle], [needle], shafts=shafts).search(3e-3, 0.15)[0]
        assert len(found) == count


@pytest.mark.parametrize(("ends", "count"), [(0.2, 1), (0.1, 0)])
def test_hardly_visible_ends_are_no_sighting(
    search: Search, needle: np.ndarray, ends: float, count: int
) -> None:
    assert len(search([needle], [needle], ends=ends).search(3e-3, 0.15)[0]) == count


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


def test_evidence_is_the_sum_over_views_and_maps(views: Views, needle: np.ndarray) -> None:
    ends = (
        DrawnLines(view, [needle]).ends_near(view.project(needle[-1]), np.zeros(2), hidden=False)[0]
        for view in views
    )
    left, right = ends
    tip = triangulate(views, (left, right), needle[-1])
    assert tip is not None
    doubtful = dataclasses.replace(right, ends=0.05, shaft=1.0 - left.shaft)
    assert evidence((left, doubtful), tip) == pytest.approx(-0.5 * tip.misfit, abs=1e-9)
    shaft = np.log(left.shaft / (1.0 - left.shaft))
    added = 2.0 * np.log(0.95 / 0.05) + shaft
    assert evidence((left, right), tip) == pytest.approx(added - 0.5 * tip.misfit)
    assert evidence((left, dataclasses.replace(right, ends=1.5)), tip) < 10.0


@pytest.mark.parametrize("roll", [0.0, 0.7, 1.6, 3.0])
@pytest.mark.parametrize("curvature", [2.0, 7.0])
def test_the_length_is_that_of_the_arc_despite_the_steps_of_the_cells(
    curvature: float, roll: float
) -> None:
    points = drawn_needles.arc(0.07, curvature, roll)
    rng = np.random.default_rng(0)
    steps = rng.uniform(-0.5e-3, 0.5e-3, points.shape)
    steps[-1] = 0.0
    assert shaft_length(points + steps) == pytest.approx(0.07, abs=0.2e-3)
    # Clutter deflects a part of the path.
    steps[20:26] += 4e-3
    assert shaft_length(points + steps) == pytest.approx(0.07, abs=0.3e-3)
