"""Tracks that earlier insertions left in the phantom stay where they are; the needle does not."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable

import cv2
import numpy as np
import pytest

from needle_tracker.filter.needle_tracker import Image, NeedleTracker
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.stereo.triangulation import SpatialTip
from needle_tracker.tracker_parameters import StereoTrackerParameters

SHAPE = (768, 1024)
WIDTH_PX = 4.6
Pair = tuple[Image, Image]
Draw = Callable[[Iterable[np.ndarray], int], Pair]


@pytest.fixture
def draw(
    views: tuple[RefractedCamera, RefractedCamera], make_line: Callable[..., np.ndarray]
) -> Draw:
    """Return what draws dark lines in a phantom over a plain floor, and noise."""

    @functools.cache
    def cover(view: RefractedCamera, path: bytes) -> np.ndarray:
        points = np.frombuffer(path).reshape(-1, 3)
        return make_line(SHAPE, view.project(points), WIDTH_PX, 1.0, 0.0)

    def drawn(paths: Iterable[np.ndarray], seed: int) -> Pair:
        rng = np.random.default_rng(seed)
        images = []
        for view in views:
            image = np.full(SHAPE, 160.0)
            for path in paths:
                image -= 80.0 * cover(view, path.tobytes())
            image = cv2.GaussianBlur(image, (0, 0), 0.7) + rng.normal(0.0, 3.0, SHAPE)
            images.append(np.asarray(np.clip(image, 0.0, 255.0), np.uint8))
        return images[0], images[1]

    return drawn


@pytest.fixture
def track(make_arc: Callable[..., np.ndarray]) -> np.ndarray:
    """Return the path of an earlier insertion of 70 mm."""
    return np.asarray(make_arc(0.070, 6.0, 2.5, 0.05))


def believed(
    tracker: NeedleTracker, pairs: Iterable[tuple[Pair, float | None]]
) -> list[SpatialTip | None]:
    return [tracker.process(*pair, insertion).tip for pair, insertion in pairs]


def is_at(tip: SpatialTip | None, place: np.ndarray) -> bool:
    return tip is not None and float(np.linalg.norm(tip.position - place)) < 1e-3


def test_a_track_since_the_empty_phantom_gives_way_to_the_needle_that_moves(
    calibration: StereoCalibration,
    settings: StereoTrackerParameters,
    draw: Draw,
    track: np.ndarray,
    make_arc: Callable[..., np.ndarray],
) -> None:
    tracker = NeedleTracker(calibration, settings, draw([], 99))
    lengths = [0.0, 0.0, *(0.03 + 1e-3 * i for i in range(6))]
    needles = [make_arc(length, 6.0, 0.4) for length in lengths]
    tips = believed(
        tracker,
        (
            (draw([track, needle] if length else [track], i), None)
            for i, (length, needle) in enumerate(zip(lengths, needles, strict=True))
        ),
    )
    assert not any(is_at(tip, track[-1]) for tip in tips)
    right = [is_at(tip, path[-1]) for tip, path in zip(tips, needles, strict=True)]
    assert all(right[-4:])


def test_a_track_since_the_empty_phantom_is_not_believed_if_nothing_moves(
    calibration: StereoCalibration, settings: StereoTrackerParameters, draw: Draw, track: np.ndarray
) -> None:
    tracker = NeedleTracker(calibration, settings, draw([], 99))
    # Now and then nothing is seen: that begins nothing anew.
    pairs = [draw([track] if i % 4 < 3 else [], i) for i in range(12)]
    tips = believed(tracker, ((pair, None) for pair in pairs))
    assert not any(tips)


def test_a_track_that_the_insertion_passes_is_dropped(
    calibration: StereoCalibration, draw: Draw, track: np.ndarray
) -> None:
    tracker = NeedleTracker(calibration, StereoTrackerParameters())
    insertions = [0.067 + 0.5e-3 * i for i in range(22)]
    tips = believed(tracker, ((draw([track], i), at) for i, at in enumerate(insertions)))
    seen = [at for tip, at in zip(tips, insertions, strict=True) if tip is not None]
    # As long as it may be the needle's end it may be taken for it.
    assert not seen or seen[-1] - seen[0] <= 5e-3
