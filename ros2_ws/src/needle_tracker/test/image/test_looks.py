"""Paths and ends in needle maps: where they may begin and end, how sure a map must be."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from needle_tracker.image.background import Background
from needle_tracker.image.detection import DetectionSettings
from needle_tracker.image.looks import MapLook
from needle_tracker.image.search_grid import SearchGrid, make_search_grid
from needle_tracker.image.tip_fit import Expected
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracking.tracker_settings import TrackerSettings

SHAPE, WIDTH_PX = (768, 1024), 4.6


@pytest.mark.parametrize(("hidden", "seen"), [(0.02, True), (0.04, False)])
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


def drawn(end: int, seed: int, *, paper: bool) -> np.ndarray:
    """Draw a needle from the left over graph paper, or a wide plain floor, up to a column."""
    image = np.full((240 if paper else 1600, 320), 150.0, np.float32)
    for at in range(10, 320, 20) if paper else ():
        cv2.line(image, (at, 0), (at, 239), 60.0, 2)
        cv2.line(image, (0, at), (319, at), 60.0, 2)
    cv2.line(image, (0, 121), (end, 121), 20.0, 5, cv2.LINE_AA)
    image += np.random.default_rng(seed).normal(0.0, 2.0 if paper else 5.0, image.shape)
    return np.asarray(np.clip(image, 0.0, 255.0), np.uint8)


@pytest.mark.parametrize("paper", [True, False])
@pytest.mark.parametrize(
    ("before", "now", "come"),
    [(100, 200, True), (200, 100, False), (200, 200, False), (193, 200, False)],
)
def test_a_needle_has_come_where_there_was_none_of_it(
    before: int, now: int, come: bool, paper: bool
) -> None:
    look = MapLook(WIDTH_PX, 0.0)
    earlier = drawn(before, 1, paper=paper)
    look.background = Background(earlier, np.array([0.0, 121.0]), 3.0 * WIDTH_PX)
    point = np.array([float(now), 121.0])
    expected = Expected(point, np.array([1.0, 0.0]), 90.0, 6, 0.0, 0.0)
    image = drawn(now, 2, paper=paper)
    assert (look.background.difference(image) is None) is not paper
    found = look.fit(image, expected, True, DetectionSettings(needle_width_px=WIDTH_PX))
    assert (found is not None and found.come) is come


def test_a_needle_has_come_whatever_else_is_new_beyond_it() -> None:
    look = MapLook(WIDTH_PX, 0.0)
    look.background = Background(drawn(0, 1, paper=True), np.array([0.0, 121.0]), 3.0 * WIDTH_PX)
    image = drawn(160, 2, paper=True)
    cv2.line(image, (205, 70), (240, 66), 20, 5, cv2.LINE_AA)
    expected = Expected(np.array([160.0, 121.0]), np.array([1.0, 0.0]), 90.0, 60, 0.0, 0.0)
    found = look.fit(image, expected, True, DetectionSettings(needle_width_px=WIDTH_PX))
    assert found is not None
    assert abs(found.point[0] - 160.0) < WIDTH_PX
    assert found.come


def test_an_old_track_has_not_come_though_the_empty_phantom_lacks_it() -> None:
    look = MapLook(WIDTH_PX, 0.0)
    entry = np.array([0.0, 121.0])
    look.background = Background(drawn(0, 1, paper=True), entry, None)
    look.earlier = MapLook(WIDTH_PX, 0.0)
    look.earlier.background = Background(drawn(200, 2, paper=True), entry, 3.0 * WIDTH_PX)
    for end, come in ((200, False), (240, True)):
        expected = Expected(np.array([float(end), 121.0]), np.array([1.0, 0.0]), 90.0, 6, 0.0, 0.0)
        image = drawn(end, 3, paper=True)
        found = look.fit(image, expected, True, DetectionSettings(needle_width_px=WIDTH_PX))
        assert found is not None
        assert found.all_new
        assert found.come is come


def shown(
    monkeypatch: pytest.MonkeyPatch, lines: list[tuple[np.ndarray, float]]
) -> tuple[MapLook, np.ndarray]:
    """Return a look whose map is drawn by hand: points in the image and how sure each line is."""
    drawn = np.zeros(SHAPE, np.uint8)
    for pixels, sure in lines:
        corners = [np.round(16.0 * pixels).astype(np.int32)]
        cv2.polylines(drawn, corners, False, round(255.0 * sure), 4, cv2.LINE_AA, 4)
    monkeypatch.setattr(MapLook, "_draw", lambda *_: drawn)
    return MapLook(WIDTH_PX, 0.0), np.zeros(SHAPE, np.uint8)


@pytest.fixture
def grid(views: tuple[RefractedCamera, RefractedCamera], settings: TrackerSettings) -> SearchGrid:
    return make_search_grid(views[0], settings.gates.reach, first_distance=4e-3)


def straight(grid: SearchGrid) -> np.ndarray:
    """Return the pixels of a needle that goes straight on."""
    return grid.pixels[:81, int(np.searchsorted(grid.angles, 0.0))]


def end_of(needle: np.ndarray) -> Expected:
    direction = (needle[-1] - needle[-9]) / np.linalg.norm(needle[-1] - needle[-9])
    return Expected(needle[-1], direction, 100.0, 6, 0.0)


def test_an_end_is_found_though_the_way_to_what_follows_leaves_the_needle_before_it(
    grid: SearchGrid,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    aside = int(np.searchsorted(grid.angles, 4e-3 / grid.distances[84]))
    needle, track = straight(grid), grid.pixels[84:, aside]
    look, image = shown(monkeypatch, [(needle, 1.0), (track, 1.0)])
    found = look.find_paths(image, grid, DetectionSettings(needle_width_px=WIDTH_PX), None)
    off = [np.linalg.norm(each.pixels[-1] - needle[-1]) for each in found]
    assert min(off) < 1.5 * WIDTH_PX


@pytest.mark.parametrize(("sure", "seen"), [(1.0, True), (0.12, True), (0.02, False)])
def test_a_map_that_is_as_unsure_of_all_of_a_needle_shows_its_end(
    grid: SearchGrid,
    monkeypatch: pytest.MonkeyPatch,
    *,
    sure: float,
    seen: bool,
) -> None:
    needle = straight(grid)
    look, image = shown(monkeypatch, [(needle, sure)])
    detection = DetectionSettings(needle_width_px=WIDTH_PX)
    found = look.find_paths(image, grid, detection, None)
    assert bool(found) is seen
    tip = look.fit(image, end_of(needle), True, detection)
    assert (tip is not None and tip.clear) is seen
    if tip is not None:
        assert np.linalg.norm(tip.point - needle[-1]) < WIDTH_PX


def test_how_sure_two_maps_are_does_not_tell_two_needles_apart(
    grid: SearchGrid,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    needle = straight(grid)
    expected, tips = end_of(needle), []
    for sure in (1.0, 0.6):
        look, image = shown(monkeypatch, [(needle, sure)])
        tip = look.fit(image, expected, True, DetectionSettings(needle_width_px=WIDTH_PX))
        assert tip is not None
        tips.append(tip)
    assert tips[1].contrast < 0.8 * tips[0].contrast
    assert tips[1].visibility == tips[0].visibility
