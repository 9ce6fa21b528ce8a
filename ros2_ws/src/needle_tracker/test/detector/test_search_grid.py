"""Search grid: reach of the needle, and its pixels in both images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from needle_tracker.detector.search_grid import GRID, make_search_grid
from needle_tracker.optics.calibration import load_calibration
from needle_tracker.optics.refraction import stereo_views
from needle_tracker.tracker_parameters import StereoTrackerParameters


@pytest.mark.parametrize("rig", ["calibration.yaml", "calibration_top_and_side.yaml"])
def test_each_cell_has_its_pixels_in_both_images(calibration_path: Path, rig: str) -> None:
    views = stereo_views(load_calibration(calibration_path.with_name(rig)))
    grid = make_search_grid(views, StereoTrackerParameters(max_insertion=0.06))
    some = np.arange(0, len(grid.columns), 97)
    points = grid.points(some)
    for view, seen in zip(views, grid.views, strict=True):
        np.testing.assert_allclose(seen.pixels[some], view.project(points), atol=0.4)
        assert view.camera.window.depth(points).min() > -0.1e-3
        assert seen.pixels.min() >= GRID.border_px
        for row in (5, 40):
            pixels = seen.pixels[grid.starts[row] : grid.starts[row + 1]]
            np.testing.assert_allclose(seen.boxes[row, :2], pixels.min(axis=0), atol=1e-3)
            np.testing.assert_allclose(seen.boxes[row, 2:], pixels.max(axis=0), atol=1e-3)


def test_the_grid_covers_the_reach_of_the_needle(calibration_path: Path) -> None:
    views = stereo_views(load_calibration(calibration_path))
    needle = StereoTrackerParameters(max_insertion=0.08)
    grid = make_search_grid(views, needle)
    for distance in (0.02, 0.05, 0.075):
        row = grid.row_of(distance)
        points = grid.points(np.arange(grid.starts[row], grid.starts[row + 1]))
        np.testing.assert_allclose(np.linalg.norm(points, axis=1), distance, atol=0.51e-3)
        widest = np.arccos(points[:, 2] / np.linalg.norm(points, axis=1)).max()
        reach = float(needle.chord_angle(np.array(distance)))
        assert reach - GRID.angle_pitch < widest < reach + 0.1
        # Below, beside and ahead of the axis, but not above the surface.
        assert points[:, 0].max() < views[0].camera.window.point[0] + 0.1e-3


def test_rows_of_unreachable_distances_are_the_first_and_the_last(calibration_path: Path) -> None:
    views = stereo_views(load_calibration(calibration_path))
    grid = make_search_grid(views, StereoTrackerParameters(max_insertion=0.06))
    assert grid.row_of(0.0) == 0
    assert grid.row_of(1.0) == len(grid.distances) - 1
