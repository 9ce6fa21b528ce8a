"""Paths through the search grid, on scores written cell by cell."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from needle_tracker.detector.search_grid import GridView, SearchGrid, make_search_grid
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.stereo.shaft_search import SEARCH, Shaft, find_shafts
from needle_tracker.tracker_parameters import StereoTrackerParameters

Scores = tuple[np.ndarray, np.ndarray]
END_ROW = 60


@pytest.fixture(scope="module")
def grid(views: tuple[RefractedCamera, RefractedCamera]) -> SearchGrid:
    return make_search_grid(views, StereoTrackerParameters(max_insertion=0.1))


@dataclasses.dataclass
class KnownScores:
    """Stand-in for a detector: scores of all cells."""

    values: Scores

    def scores(self, grid: SearchGrid, seen: GridView, last_row: int, *, full_size: bool) -> Scores:
        cells = grid.starts[last_row + 1]
        return self.values[0][:cells], self.values[1][:cells]


def search(
    grid: SearchGrid, left: Scores, right: Scores, least: float = 3e-3, most: float = 0.1
) -> list[Shaft]:
    detectors = KnownScores(left), KnownScores(right)
    return find_shafts(grid, detectors, least, most)  # type: ignore[arg-type]


def drawn(
    grid: SearchGrid, last: int, *, lean: float = 0.0, first: int = 0, end: float = 6.0
) -> Scores:
    """Return the scores of a straight shaft that leans in y, with an end in its last row."""
    rows = np.repeat(np.arange(len(grid.distances)), np.diff(grid.starts))
    points = grid.points(np.arange(len(rows)))
    off = points / grid.distances[rows, None] - [0.0, np.sin(lean), np.cos(lean)]
    line = (np.linalg.norm(off, axis=1) < 0.012) & (first <= rows) & (rows <= last)
    ends = np.where(line & (rows == last), end, -3.0)
    return np.where(line, 1.0, -1.0).astype(np.float32), ends.astype(np.float32)


def both(one: Scores, other: Scores) -> Scores:
    return np.maximum(one[0], other[0]), np.maximum(one[1], other[1])


def end_row(grid: SearchGrid, shaft: Shaft) -> int:
    return int(np.searchsorted(grid.starts, shaft.cells[-1], side="right")) - 1


def test_the_path_runs_along_the_shaft_to_its_end(grid: SearchGrid) -> None:
    scores = drawn(grid, END_ROW, lean=0.1)
    best = search(grid, scores, scores)[0]
    points = grid.points(best.cells)
    assert end_row(grid, best) == END_ROW
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), grid.distances[: END_ROW + 1])
    np.testing.assert_allclose(points[-1] / grid.distances[END_ROW], [0, 0.1, 0.995], atol=0.015)
    assert best.score == pytest.approx(SEARCH.path_limit + 12.0)


def test_a_line_that_only_one_view_shows_scores_less(grid: SearchGrid) -> None:
    needle, line, floor = drawn(grid, 40), drawn(grid, END_ROW, lean=0.15), drawn(grid, -1)
    shafts = search(grid, both(needle, line), both(needle, floor))
    found = {end_row(grid, shaft): shaft.score for shaft in reversed(shafts)}
    assert found[40] == max(found.values())
    assert found[END_ROW] < found[40] - SEARCH.path_limit


def test_a_gap_is_bridged_and_an_end_before_it_is_another_candidate(grid: SearchGrid) -> None:
    near, far = drawn(grid, 30, end=4.0), drawn(grid, END_ROW, first=36)
    rows = {end_row(grid, shaft) for shaft in search(grid, both(near, far), both(near, far))}
    assert rows >= {30, END_ROW}


def test_ends_are_only_at_the_given_distances(grid: SearchGrid) -> None:
    scores = drawn(grid, END_ROW)
    for shaft in search(grid, scores, scores, 0.07, 0.08):
        assert 0.069 < np.linalg.norm(grid.points(shaft.cells)[-1]) < 0.081


def test_a_shaft_that_begins_away_from_the_entry_scores_less(grid: SearchGrid) -> None:
    whole, part = drawn(grid, 12), drawn(grid, 12, first=5)
    scores = [search(grid, each, each)[0].score for each in (whole, part)]
    assert scores[0] == pytest.approx(SEARCH.path_limit + 12.0)
    assert scores[1] == pytest.approx(SEARCH.late_start + 2.0 * 8 + 12.0)


def test_a_line_that_comes_within_reach_far_from_the_entry_is_no_shaft(grid: SearchGrid) -> None:
    line = drawn(grid, END_ROW, first=END_ROW // 2 + 1)
    assert END_ROW not in {end_row(grid, shaft) for shaft in search(grid, line, line)}


def test_a_long_line_without_an_end_does_not_hide_a_short_needle(grid: SearchGrid) -> None:
    line = drawn(grid, len(grid.distances) - 1, lean=-0.2, end=-3.0)
    scores = both(drawn(grid, 20, lean=0.1), line)
    assert end_row(grid, search(grid, scores, scores)[0]) == 20


def test_floor_alone_has_no_path(grid: SearchGrid) -> None:
    floor = drawn(grid, -1)
    assert search(grid, floor, floor) == []
