"""Paths in needle maps: where they may begin."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from needle_tracker.image.detection import DetectionSettings
from needle_tracker.image.looks import MapLook
from needle_tracker.image.search_grid import make_search_grid
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracking.tracker_settings import TrackerSettings

SHAPE, WIDTH_PX = (768, 1024), 4.6


@pytest.mark.parametrize(("hidden", "seen"), [(0.006, True), (0.02, True), (0.04, False)])
def test_a_box_may_hide_where_a_needle_enters_as_long_as_most_of_it_is_seen(
    views: tuple[RefractedCamera, RefractedCamera],
    settings: TrackerSettings,
    make_line: Callable[..., np.ndarray],
    make_arc: Callable[..., np.ndarray],
    hidden: float,
    seen: bool,
) -> None:
    view = views[0]
    path = make_arc(0.06, 5.0, 0.7)
    pixels = view.project(path)
    image = 150.0 - 110.0 * make_line(SHAPE, pixels, WIDTH_PX, 1.0, 0.0)
    edge = view.project(np.array([[0.0, 0.0, hidden]]))[0]
    along = (pixels[-1] - pixels[0]) / np.linalg.norm(pixels[-1] - pixels[0])
    rows, columns = np.indices(SHAPE)
    image[(np.stack([columns, rows], axis=-1) - edge) @ along < 0.0] = 20.0
    image += np.random.default_rng(3).normal(0.0, 2.0, SHAPE)
    grid = make_search_grid(view, settings.gates.reach, first_distance=settings.hole_clearance)
    look = MapLook(WIDTH_PX, 0.0)
    found = look.find_paths(
        np.asarray(np.clip(image, 0, 255), np.uint8),
        grid,
        DetectionSettings(needle_width_px=WIDTH_PX),
        None,
    )
    ends = [np.linalg.norm(each.pixels[-1] - pixels[-1]) < 2.0 * WIDTH_PX for each in found]
    assert any(ends) is seen
