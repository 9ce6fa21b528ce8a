"""Needles that are no plain line: under a lamp, and on graph paper."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from needle_tracker.filter.needle_tracker import Image, NeedleTracker
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracker_parameters import StereoTrackerParameters

MakeArc = Callable[..., np.ndarray]
Views = tuple[RefractedCamera, RefractedCamera]
Pair = tuple[Image, Image]
SHAPE = (768, 1024)


def mirroring(
    views: Views, make_line: Callable[..., np.ndarray], path: np.ndarray, seed: int
) -> tuple[Image, Image]:
    """Draw a shaft whose core mirrors a lamp and whose rims mirror the dark, on a grey floor."""
    rng = np.random.default_rng(seed)
    images = []
    for view in views:
        shape = (view.camera.height, view.camera.width)
        image = np.full(shape, 140.0)
        for level, width in ((75.0, 4.6), (235.0, 2.0)):
            share = make_line(shape, view.project(path), width, 1.0, 0.0)
            image += share * (level - image)
        image = cv2.GaussianBlur(image, (0, 0), 0.6) + rng.normal(0.0, 4.0, shape)
        images.append(np.clip(image, 0, 255).astype(np.uint8))
    return images[0], images[1]


@pytest.mark.parametrize("known", [True, False])
def test_a_needle_that_mirrors_a_lamp_is_found(
    calibration: StereoCalibration,
    views: Views,
    make_arc: MakeArc,
    make_line: Callable[..., np.ndarray],
    known: bool,
) -> None:
    tracker = NeedleTracker(calibration, StereoTrackerParameters())
    found = 0
    for mm in range(60, 68):
        path = make_arc(1e-3 * mm, 6.0, 0.7)
        images = mirroring(views, make_line, path, mm)
        tip = tracker.process(*images, 1e-3 * mm if known else None).tip
        if tip is not None:
            found += 1
            assert np.linalg.norm(tip.position - path[-1]) < 0.5e-3
    assert found >= 5


@pytest.fixture
def on_graph_paper(
    views: Views, make_line: Callable[..., np.ndarray], make_arc: Callable[..., np.ndarray]
) -> Callable[[float, int], tuple[Pair, np.ndarray]]:
    """Return what draws a grey needle over paper; one line of it runs along the needle's end."""
    last = make_arc(0.068, 5.0, 0.7)
    ahead = (last[-1] - last[-5]) / np.linalg.norm(last[-1] - last[-5])

    def draw(length: float, seed: int) -> tuple[Pair, np.ndarray]:
        rng = np.random.default_rng(seed)
        path = make_arc(length, 5.0, 0.7) if length else np.zeros((1, 3))
        images = []
        for view in views:
            image = np.full(SHAPE, 170.0)
            middle, beyond = view.project(np.stack([last[-1], last[-1] + 1e-2 * ahead]))
            along = (beyond - middle) / np.linalg.norm(beyond - middle)
            beside = np.array([-along[1], along[0]])
            for k in range(-12, 13):
                for at, way in ((40.0 * k * beside, along), (40.0 * k * along, beside)):
                    points = np.stack([middle + at - 900.0 * way, middle + at + 900.0 * way])
                    begin, end = np.rint(points).astype(int).tolist()
                    cv2.line(image, begin, end, 60.0, 4, cv2.LINE_AA)
            if length:
                image += make_line(SHAPE, view.project(path), 4.6, 1.0, 0.0) * (40.0 - image)
            image = cv2.GaussianBlur(image, (0, 0), 0.7) + rng.normal(0.0, 2.0, SHAPE)
            images.append(np.asarray(np.clip(image, 0, 255), np.uint8))
        return (images[0], images[1]), path[-1]

    return draw


def test_an_end_on_a_line_of_graph_paper_is_not_believed_wrongly(
    calibration: StereoCalibration,
    settings: StereoTrackerParameters,
    on_graph_paper: Callable[[float, int], tuple[Pair, np.ndarray]],
) -> None:
    reference, _ = on_graph_paper(0.0, 1)
    tracker = NeedleTracker(calibration, settings, reference)
    for mm in (66, 67, 68):
        pair, truth = on_graph_paper(1e-3 * mm, mm)
        tip = tracker.process(*pair, 1e-3 * mm).tip
        assert tip is None or np.linalg.norm(tip.position - truth) < 0.75e-3
