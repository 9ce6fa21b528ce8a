"""Which pair is kept as what stands behind the needle, and what that does for maps."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from needle_tracker.image.backgrounds import Backgrounds
from needle_tracker.image.detection import Image
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracking.tip_tracker import TipTracker
from needle_tracker.tracking.tracker_settings import TrackerSettings

Views = tuple[RefractedCamera, RefractedCamera]
Pair = tuple[Image, Image]
CLEARANCE, WIDTH = 2e-3, 0.7e-3
SHAPE = (768, 1024)


def marked(level: int) -> Pair:
    """Return a pair with a bright and dark pattern of a strength of its own."""
    image = np.full(SHAPE, 100, np.uint8)
    image[::3] = 100 + level
    return image, image.copy()


def contents(backgrounds: Backgrounds, insertion: float | None) -> bool:
    """Return whether what is kept was taken without a needle."""
    return backgrounds.see(marked(9), insertion)[0].is_empty


@pytest.mark.parametrize("insertion", [None, 0.060])
def test_the_first_pair_is_kept_until_there_is_less_of_the_needle(
    views: Views, insertion: float | None
) -> None:
    backgrounds = Backgrounds(views, CLEARANCE, WIDTH, None)
    first = backgrounds.see(marked(9), insertion)
    assert not first[0].is_empty
    assert backgrounds.see(marked(30), None) is first
    less = backgrounds.see(marked(30), 0.055)
    assert less is not first
    assert backgrounds.see(marked(9), 0.060) is less
    assert contents(backgrounds, None) is False


def test_a_pair_without_needle_holds_for_all_that_follow(views: Views) -> None:
    backgrounds = Backgrounds(views, CLEARANCE, WIDTH, None)
    assert contents(backgrounds, 0.001) is True
    assert contents(backgrounds, 0.060) is True
    assert contents(backgrounds, None) is True


def test_the_latest_pair_without_needle_counts(views: Views) -> None:
    backgrounds = Backgrounds(views, CLEARANCE, WIDTH, marked(40))
    now = marked(80)
    kept = backgrounds.see(now, 0.06)
    assert kept[0].difference(now[0]) is not None
    backgrounds.see(now, 0.0015)
    kept = backgrounds.see(now, 0.06)
    difference = kept[0].difference(now[0])
    assert difference is not None
    assert float(difference.std()) < 1.0


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


def test_an_end_on_a_line_of_graph_paper_is_found_before_the_empty_phantom(
    calibration: StereoCalibration,
    settings: TrackerSettings,
    on_graph_paper: Callable[[float, int], tuple[Pair, np.ndarray]],
) -> None:
    reference, _ = on_graph_paper(0.0, 1)
    settings = dataclasses.replace(settings, bright=None)
    told = TipTracker(calibration, dataclasses.replace(settings, reference=reference))
    blind = TipTracker(calibration, settings)
    found: dict[bool, int] = {True: 0, False: 0}
    for mm in (66, 67, 68):
        pair, truth = on_graph_paper(1e-3 * mm, mm)
        for tracker in (told, blind):
            tip = tracker.process(*pair, 1e-3 * mm).tip
            if tip is not None and np.linalg.norm(tip.position - truth) < 0.5e-3:
                found[tracker is told] += 1
    # The first one waits to be borne out.
    assert found == {True: 2, False: 0}
