"""Coarse paths in one image: the largest sums, the length along a path, what a path looks like."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from needle_tracker.image.detection import (
    DetectionSettings,
    Path,
    cut_path,
    find_paths,
    of_one_polarity,
)
from needle_tracker.image.search_grid import SearchGrid, make_search_grid
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracking.tracker_settings import TrackerSettings

Views = tuple[RefractedCamera, RefractedCamera]


def small_grid(rows: int, columns: int, *, angle_pitch: float) -> SearchGrid:
    """Return a grid whose cells are whole pixels, a row of the image each."""
    across, down = np.meshgrid(10.0 + 2.0 * np.arange(columns), 10.0 + 2.0 * np.arange(rows))
    pixels = np.stack([across, down], axis=-1).astype(np.float32)
    low = np.minimum.accumulate(pixels.min(axis=1))
    high = np.maximum.accumulate(pixels.max(axis=1))
    return SearchGrid(
        np.array([0.0, 1.0, 0.0]),
        np.asarray(4e-3 + 0.5e-3 * np.arange(rows), dtype=np.float64),
        np.asarray(angle_pitch * (np.arange(columns) - columns // 2), dtype=np.float64),
        pixels,
        np.ones((rows, columns), dtype=np.bool_),
        np.stack([low, high], axis=1),
    )


def largest_sum(evidence: np.ndarray, steps: np.ndarray, first_end: int) -> float:
    """Return the largest sum along any path, by trying every one."""
    rows, columns = evidence.shape
    best = -np.inf
    for end in range(first_end, rows):
        for path in itertools.product(range(columns), repeat=end + 1):
            moves = np.abs(np.diff(path))
            if np.all(moves <= steps[1 : end + 1]):
                best = max(best, float(evidence[np.arange(end + 1), path].sum()))
    return best


@pytest.mark.parametrize("seed", range(2))
def test_the_best_path_is_the_best_of_all(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(seed)
    rows, columns = 5, 6
    # One cell sideways per row at the far end, two at the near one.
    grid = small_grid(rows, columns, angle_pitch=0.09)
    ridge = rng.uniform(-20.0, 20.0, (rows, columns)).astype(np.float32)
    monkeypatch.setattr("needle_tracker.image.detection._sampled_ridge", lambda *_: (ridge, 1.0))
    settings = DetectionSettings(bright=True, min_contrast=4.0, min_length=0.0, min_coverage=0.0)
    image = np.zeros((30, 30), np.uint8)
    threshold = 5.0
    paths = find_paths(image, grid, settings, ends=(3, rows - 1))
    over = ridge.astype(np.float64) - threshold
    evidence = np.clip(over, -threshold, 2.0 * threshold)
    evidence += 0.3 * np.clip(over - 2.0 * threshold, 0.0, 8.0 * threshold)
    steps = np.ceil(0.5e-3 / (grid.distances * 0.09)).astype(int)
    assert set(steps) == {1, 2}
    best = largest_sum(evidence, steps, 3)
    assert best > 0.0
    found = [path for path in paths if path.evidence == pytest.approx(best / threshold, rel=1e-5)]
    assert found
    chosen = evidence[found[0].rows, found[0].columns].sum()
    assert chosen == pytest.approx(best, rel=1e-5)
    assert np.all(np.abs(np.diff(found[0].columns)) <= steps[1 : len(found[0].columns)])


def path_along(grid: SearchGrid, angles: np.ndarray) -> Path:
    rows = np.arange(len(grid.distances))
    columns = np.rint((angles - grid.angles[0]) / grid.angle_pitch).astype(np.int64)
    return Path(rows, columns, grid.pixels[rows, columns].astype(np.float64), 30.0)


@pytest.mark.parametrize("curvature", [0.0, 8.0])
@pytest.mark.parametrize("length", [8e-3, 93.2e-3])
def test_a_path_is_cut_at_its_length(
    views: Views, settings: TrackerSettings, curvature: float, length: float
) -> None:
    grid = make_search_grid(views[0], settings.gates.reach, first_distance=4e-3)
    # Along an arc that starts along z the chord turns half as fast as the needle.
    path = path_along(grid, np.arcsin(0.5 * curvature * grid.distances))
    cut = cut_path(path, grid, length)
    chord = 2.0 / curvature * np.sin(0.5 * curvature * length) if curvature else length
    end = grid.distances[cut.rows[-1]]
    # Good to a row, and to what the cells' steps make longer.
    assert end == pytest.approx(chord, abs=grid.row_pitch + 4e-3 * length)
    np.testing.assert_array_equal(cut.columns, path.columns[: len(cut.rows)])
    np.testing.assert_array_equal(cut.pixels, path.pixels[: len(cut.rows)])


def test_a_path_shorter_than_the_length_stays_whole(
    views: Views, settings: TrackerSettings
) -> None:
    grid = make_search_grid(views[0], settings.gates.reach, first_distance=4e-3)
    path = path_along(grid, np.zeros(len(grid.distances)))
    assert len(cut_path(path, grid, 1.0).rows) == len(path.rows)
    assert len(cut_path(path, grid, 0.0).rows) == 2


def test_what_a_path_looks_like_is_its_median_and_its_share(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    grid = small_grid(7, 5, angle_pitch=0.09)
    ridge = np.full((7, 5), 30.0, np.float32)
    ridge[:, 2] = [-40.0, -12.0, 3.0, -25.0, -4.0, -60.0, -31.0]
    monkeypatch.setattr("needle_tracker.image.detection._sampled_ridge", lambda *_: (ridge, 1.0))
    settings = DetectionSettings(bright=False, min_contrast=4.0, min_length=0.0, min_coverage=0.0)
    path = find_paths(np.zeros((30, 30), np.uint8), grid, settings, ends=(6, 6))[0]
    np.testing.assert_array_equal(path.columns, np.full(7, 2))
    assert path.contrast == pytest.approx(np.median(-ridge[:, 2]))
    assert path.coverage == pytest.approx(5 / 7)


@pytest.mark.parametrize(("longest_gap", "end"), [(2.0, 30), (4.0, 30), (8.0, 59), (np.inf, 59)])
def test_a_path_ends_before_a_gap_and_not_where_the_way_across_it_leaves_the_line(
    monkeypatch: pytest.MonkeyPatch, longest_gap: float, end: int
) -> None:
    rows, columns = 60, 41
    grid = small_grid(rows, columns, angle_pitch=0.2)  # one column a row
    ridge = np.zeros((rows, columns), np.float32)
    # A line from the entry to row 30, and a plainer one aside, from row 36 on.
    ridge[:31, 20] = 40.0
    ridge[36:, 32] = 60.0
    monkeypatch.setattr("needle_tracker.image.detection._sampled_ridge", lambda *_: (ridge, 0.0))
    settings = DetectionSettings(
        bright=True,
        needle_width_px=4.0,
        min_contrast=10.0,
        min_length=0.0,
        min_coverage=0.0,
        longest_gap=longest_gap,
    )
    path = find_paths(np.zeros((200, 200), np.uint8), grid, settings, count=1)[0]
    assert path.rows[-1] == end
    assert (path.columns[:31] == 20).all() == (end == 30)


@pytest.mark.parametrize(("contrast", "found"), [(50.0, True), (8.0, False)])
def test_a_line_is_measured_against_the_noise(
    views: Views, settings: TrackerSettings, contrast: float, *, found: bool
) -> None:
    grid = make_search_grid(views[0], settings.gates.reach, first_distance=4e-3)
    camera = views[0].camera
    image = np.full((camera.height, camera.width), 120.0)
    along = path_along(grid, np.zeros(len(grid.distances))).pixels
    middle = np.interp(np.arange(camera.width), along[:, 0], along[:, 1])
    rows = np.arange(camera.height)[:, None]
    image -= contrast * (np.abs(rows - middle[None]) < 2.3)
    image += np.random.default_rng(0).normal(0.0, 8.0, image.shape)
    pixels = np.clip(image, 0.0, 255.0).astype(np.uint8)
    settings_of_line = DetectionSettings(bright=False, min_contrast=1.0)
    paths = find_paths(pixels, grid, settings_of_line, ends=(150, 200))
    assert bool(paths) is found
    if found:
        # Near the entry the grid's columns are less than a pixel apart.
        np.testing.assert_allclose(grid.angles[paths[0].columns[10:]], 0.0, atol=0.02)


@pytest.mark.parametrize("number", [float, np.float64])
def test_paths_of_the_polarity_that_stands_out_are_kept(number: type[float]) -> None:
    rows = np.arange(3)
    dark, bright = (
        Path(rows, rows, np.zeros((3, 2)), 50.0, is_bright, 1.0, number(evidence))
        for is_bright, evidence in ((False, 3.0), (True, 5.0))
    )
    left, right = of_one_polarity([[bright, dark], [bright]])
    assert left == [bright]
    assert right == [bright]
