"""Paths outwards through the search grid, on maps drawn cell by cell."""

from __future__ import annotations

import numpy as np
import pytest

from needle_tracker.detector.end_search import SEARCH, SearchGrid, find_paths, make_search_grid
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracker_parameters import StereoTrackerParameters

END_ROW = 120


@pytest.fixture(scope="module")
def grid(views: tuple[RefractedCamera, RefractedCamera]) -> SearchGrid:
    return make_search_grid(views[0], StereoTrackerParameters())


def drawn(
    grid: SearchGrid, column: int, last: int, *, first: int = 0, sure: float = 0.95
) -> tuple[np.ndarray, np.ndarray]:
    """Draw a shaft along a column of the grid, and the end in its last row."""
    shape = len(grid.distances), len(grid.angles)
    shaft = np.full(shape, 0.01, np.float32)
    ends = np.full(shape, 1e-6, np.float32)
    shaft[first : last + 1, column - 1 : column + 2] = sure
    ends[last, column] = 0.9
    return shaft, ends


def middle(grid: SearchGrid) -> int:
    return len(grid.angles) // 2


def test_the_path_runs_along_the_shaft_to_its_end(grid: SearchGrid) -> None:
    best = find_paths(grid, *drawn(grid, middle(grid), END_ROW), 1, len(grid.distances) - 1)[0]
    assert len(best.pixels) == END_ROW + 1
    np.testing.assert_allclose(best.end, grid.pixels[END_ROW, middle(grid)], atol=3.0)
    ahead = grid.pixels[END_ROW, middle(grid)] - grid.pixels[END_ROW - 20, middle(grid)]
    assert best.direction @ (ahead / np.linalg.norm(ahead)) > 0.995
    assert best.shaft > 0.9


def test_a_gap_is_bridged_and_an_end_before_it_is_another_candidate(grid: SearchGrid) -> None:
    shaft, ends = drawn(grid, middle(grid), END_ROW)
    shaft[80:90] = 0.01
    ends[80, middle(grid)] = 0.2
    paths = find_paths(grid, shaft, ends, 1, len(grid.distances) - 1)
    rows = [len(path.pixels) - 1 for path in paths]
    assert rows[0] == END_ROW
    assert 80 in rows
    assert len(paths) <= SEARCH.candidates


def test_ends_are_only_in_the_given_rows(grid: SearchGrid) -> None:
    maps = drawn(grid, middle(grid), END_ROW)
    for path in find_paths(grid, *maps, 130, 150):
        assert 130 <= len(path.pixels) - 1 <= 150


def test_two_shafts_give_two_ends(grid: SearchGrid) -> None:
    one, other = drawn(grid, middle(grid) - 30, END_ROW), drawn(grid, middle(grid) + 30, 90)
    shaft, ends = np.maximum(one[0], other[0]), np.maximum(one[1], other[1])
    paths = find_paths(grid, shaft, ends, 1, len(grid.distances) - 1)
    assert {len(path.pixels) - 1 for path in paths[:2]} == {END_ROW, 90}


def test_a_shaft_that_begins_away_from_the_entry_scores_less(grid: SearchGrid) -> None:
    last = len(grid.distances) - 1
    whole = find_paths(grid, *drawn(grid, middle(grid), END_ROW), 1, last)[0]
    part = find_paths(grid, *drawn(grid, middle(grid), END_ROW, first=END_ROW - 9), 1, last)[0]
    assert part.score < whole.score - 3.0


def test_a_long_line_without_an_end_does_not_hide_a_short_needle(grid: SearchGrid) -> None:
    last = len(grid.distances) - 1
    line, _ = drawn(grid, middle(grid) - 40, last)
    shaft, ends = drawn(grid, middle(grid) + 20, 40)
    best = find_paths(grid, np.maximum(shaft, line), ends, 1, last)[0]
    assert len(best.pixels) == 41


def test_floor_alone_has_no_path(grid: SearchGrid) -> None:
    shape = len(grid.distances), len(grid.angles)
    empty = np.full(shape, 0.01, np.float32), np.zeros(shape, np.float32)
    assert find_paths(grid, *empty, 1, shape[0] - 1) == []
