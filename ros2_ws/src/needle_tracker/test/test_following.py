"""What two views are worth that contradict the prediction, and a bevelled end's extreme point."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from needle_tracker.detection import DetectionSettings
from needle_tracker.following import weighed
from needle_tracker.refraction import RefractedCamera
from needle_tracker.tip_fit import Expected, ImageTip, fit_expected
from needle_tracker.tip_motion import TipMotion
from needle_tracker.tracker import StereoTracker
from needle_tracker.triangulation import triangulate

Views = tuple[RefractedCamera, RefractedCamera]
TIP = np.array([0.002, -0.003, 0.06])
HEADING = np.array([0.0, 0.0, 1.0])
PREDICTED = TipMotion(TIP, HEADING, np.diag([0.05e-3**2] * 3 + [0.02**2] * 3))


@pytest.fixture
def tips(views: Views) -> tuple[ImageTip, ImageTip]:
    """Return both views of the needle where it is predicted."""
    found = []
    for view in views:
        pixel = view.project(TIP)
        along = view.jacobian(TIP) @ HEADING
        found.append(ImageTip(pixel, along / np.linalg.norm(along), 0.05, 0.1, 0.005, 100.0))
    return found[0], found[1]


def moved(tip: ImageTip, across: float, along: float, sigma: float = 0.05) -> ImageTip:
    sideways = np.array([-tip.direction[1], tip.direction[0]])
    point = tip.point + across * sideways + along * tip.direction
    return dataclasses.replace(tip, point=point, sigma_across=sigma)


def test_views_that_agree_stay_as_they_are(views: Views, tips: tuple[ImageTip, ImageTip]) -> None:
    sights = weighed(views, tips, PREDICTED)
    assert sights is not None
    assert sights.tips == tips
    assert not sights.contradicted


@pytest.mark.parametrize("side", [0, 1])
def test_a_line_across_one_view_hardly_moves_the_tip(
    views: Views, tips: tuple[ImageTip, ImageTip], side: int
) -> None:
    spoilt = [*tips]
    spoilt[side] = moved(tips[side], 6.0, 0.0, sigma=0.2)
    sights = weighed(views, (spoilt[0], spoilt[1]), PREDICTED)
    assert sights is not None
    assert sights.contradicted
    tip = triangulate(views, sights.tips)
    assert tip is not None
    merged = PREDICTED.merged(tip)
    assert np.linalg.norm(merged.position - TIP) < 0.06e-3
    raw = triangulate(views, (spoilt[0], spoilt[1]))
    assert raw is not None
    assert np.linalg.norm(raw.position - TIP) > 1e-3


def test_where_both_contradict_nothing_is_said(
    views: Views, tips: tuple[ImageTip, ImageTip]
) -> None:
    both = (moved(tips[0], 6.0, 0.0, sigma=0.2), moved(tips[1], -6.0, 0.0, sigma=0.2))
    assert weighed(views, both, PREDICTED) is None


def test_a_plain_view_is_not_outvoted_by_the_prediction(
    views: Views, tips: tuple[ImageTip, ImageTip]
) -> None:
    assert weighed(views, (moved(tips[0], 6.0, 0.0), tips[1]), PREDICTED) is None


def test_of_two_ends_the_predicted_one_counts(
    views: Views, tips: tuple[ImageTip, ImageTip]
) -> None:
    sights = weighed(views, (tips[0], moved(tips[1], 0.0, -8.0)), PREDICTED)
    assert sights is not None
    assert [tip.clear for tip in sights.tips] == [True, False]
    # Both back by as much: the needle did that, not the view.
    back = (moved(tips[0], 0.0, -8.0), moved(tips[1], 0.0, -8.0))
    sights = weighed(views, back, PREDICTED)
    assert sights is not None
    assert all(tip.clear for tip in sights.tips)


@pytest.mark.parametrize("length", [0.0, 4.0, 7.0])
def test_the_end_of_a_bevel_is_its_point(length: float) -> None:
    """Drawn 8 times too large, 4.6 px wide, slanted to the last `length` px."""
    fine, point, half = 8, 140.3, 2.3
    drawn = np.zeros((100 * fine, 200 * fine), np.float32)
    corners = np.array([[30, 50 - half], [point, 50 - half], [point - length, 50 + half]])
    corners = np.append(corners, [[30, 50 + half]], axis=0)
    cv2.fillPoly(drawn, [np.round(corners * fine * 16).astype(np.int32)], 1.0, shift=4)
    cover = cv2.resize(drawn, (200, 100), interpolation=cv2.INTER_AREA)
    cover = cv2.GaussianBlur(cover, (0, 0), 0.8)
    rng = np.random.default_rng(4)
    image = np.clip(np.round(170 - 110 * cover + rng.normal(0, 2, cover.shape)), 0, 255)
    expected = Expected(np.array([138.0, 49.5]), np.array([1.0, 0.0]), 90.0, 6, 0.0)
    tip = fit_expected(image.astype(np.uint8), expected, False, DetectionSettings())
    assert tip is not None
    # Pixel centres are at whole numbers; half the mass lies 2 and 3.5 px before the point.
    assert abs(tip.point[0] - (point - 0.5)) < 0.8
    assert abs(tip.point[0] - (point - 0.5)) < 4.0 * tip.sigma_along


def test_two_shafts_without_an_end_go_on_for_a_while_only(
    tracker: StereoTracker,
    draw_pair: Callable[..., tuple[np.ndarray, np.ndarray]],
    make_arc: Callable[..., np.ndarray],
) -> None:
    """A line that does not end hides the end: the stage says where it is, up to 5 mm."""
    images = draw_pair(make_arc(0.05, 5.0, 1.0))
    assert tracker.process(*images, 0.05).tip is not None
    endless = draw_pair(make_arc(0.08, 5.0, 1.0))
    for insertion in np.arange(0.051, 0.0551, 0.001):
        measured = tracker.process(*endless, float(insertion))
        truth = make_arc(0.08, 5.0, 1.0)
        nearest = np.linalg.norm(truth - make_arc(float(insertion), 5.0, 1.0)[-1], axis=1).min()
        assert nearest < 0.5e-3
        if measured.tip is not None:
            ahead = make_arc(float(insertion), 5.0, 1.0)[-1]
            assert np.linalg.norm(measured.tip.position - ahead) < 0.4e-3
    for insertion in np.arange(0.057, 0.062, 0.001):
        assert tracker.process(*endless, float(insertion)).tip is None


@pytest.fixture
def tracker(request: pytest.FixtureRequest) -> StereoTracker:
    calibration = request.getfixturevalue("calibration")
    return StereoTracker(calibration, request.getfixturevalue("settings"))
