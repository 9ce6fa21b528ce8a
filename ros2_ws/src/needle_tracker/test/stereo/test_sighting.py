"""Pairs of ends: what both views bear out, and what only one shows."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from needle_tracker.detector.end_fit import ImageEnd
from needle_tracker.detector.end_search import ShaftPath
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.stereo.sighting import StereoSearch, evidence
from needle_tracker.stereo.triangulation import triangulate
from needle_tracker.tracker_parameters import StereoTrackerParameters

Views = tuple[RefractedCamera, RefractedCamera]
MakeArc = Callable[..., np.ndarray]


@dataclasses.dataclass
class SeenLines:
    """In place of a detector: the lines that a camera sees, each from the entry to its end."""

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
def search(views: Views, settings: StereoTrackerParameters) -> Callable[..., StereoSearch]:
    def make(left: list[np.ndarray], right: list[np.ndarray]) -> StereoSearch:
        detectors = SeenLines(views[0], left), SeenLines(views[1], right)
        return StereoSearch(views, detectors, settings)  # type: ignore[arg-type]

    return make


@pytest.fixture
def needle(make_arc: MakeArc) -> np.ndarray:
    return np.asarray(make_arc(0.06, 6.0, 0.7))


def test_the_end_in_only_one_view_is_reported(
    search: Callable[..., StereoSearch], needle: np.ndarray
) -> None:
    sightings, (left, right) = search([needle], []).search(3e-3, 0.15)
    assert sightings == []
    assert left is not None
    assert left.ends > 0.5
    assert right is None


def test_one_needle_in_both_views_is_one_sighting(
    search: Callable[..., StereoSearch], needle: np.ndarray
) -> None:
    (sighting,) = search([needle], [needle]).search(3e-3, 0.15)[0]
    np.testing.assert_allclose(sighting.tip.position, needle[-1], atol=0.05e-3)
    assert sighting.length == pytest.approx(0.06, abs=0.2e-3)
    assert sighting.evidence > 4.0


def test_a_line_in_only_one_view_is_no_sighting(
    search: Callable[..., StereoSearch], needle: np.ndarray, make_arc: MakeArc
) -> None:
    line = make_arc(0.09, 3.0, -1.5)
    assert search([line], []).search(3e-3, 0.15)[0] == []
    found = search([line, needle], [needle]).search(3e-3, 0.15)[0]
    assert len(found) == 1
    np.testing.assert_allclose(found[0].tip.position, needle[-1], atol=0.05e-3)


def test_a_shadow_on_the_floor_is_no_sighting(
    search: Callable[..., StereoSearch], needle: np.ndarray
) -> None:
    shadow = needle * [0.0, 1.0, 1.0] - [0.02, 0.0, 0.0]
    assert search([shadow], [shadow]).search(3e-3, 0.15)[0] == []


def test_a_line_whose_tangent_misses_the_entry_is_no_sighting(
    search: Callable[..., StereoSearch], needle: np.ndarray
) -> None:
    beside = needle + np.array([0.0, 0.017, 0.0])
    assert search([beside], [beside]).search(3e-3, 0.15)[0] == []


def test_sightings_are_only_at_the_given_distances(
    search: Callable[..., StereoSearch], needle: np.ndarray
) -> None:
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
