"""What two views are worth that contradict the prediction, and a bevelled end's extreme point."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from needle_tracker.image.detection import DetectionSettings
from needle_tracker.image.tip_fit import Expected, ImageTip, fit_expected, hidden
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracking.following import HiddenEnds, weighed
from needle_tracker.tracking.tip_prediction import TipMotion
from needle_tracker.tracking.tracker import StereoTracker
from needle_tracker.tracking.triangulation import triangulate

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
        found.append(ImageTip(pixel, along / np.linalg.norm(along), 0.05, 0.1, 0.005, 100.0, 0.6))
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


def test_a_hidden_end_s_line_counts_once(tips: tuple[ImageTip, ImageTip]) -> None:
    ends = HiddenEnds()
    line = hidden(tips[0])
    counted = [ends.see((line, tips[1])) for _ in range(50)]
    information = sum(left.sigma_across**-2 for left, _ in counted)
    assert information < 2.0 * line.sigma_across**-2
    assert all(right.sigma_across == tips[1].sigma_across for _, right in counted)
    assert [tip.sigma_across for tip in ends.see(tips)] == [tip.sigma_across for tip in tips]
    assert ends.see((line, tips[1]))[0].sigma_across == line.sigma_across


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


def drawn_end(
    length: float, face: float, shade: float, blur: float, seed: int
) -> tuple[np.ndarray, float]:
    """Draw a needle 8 times too large, 4.6 px wide, its point at u = 140.

    Parameters
    ----------
    length, face : float
        Of the bevel [px], and how dark its face is beside the shaft, which is 1.
    shade : float
        Darkness of a band that lies along the needle's one side.
    blur, seed
        In pixels; of the noise.

    Returns
    -------
    image : ndarray of uint8
    end : float
        Column of the point [px].
    """
    fine, point, half = 8, 140.0, 2.3

    def filled(corners: list[list[float]]) -> np.ndarray:
        drawn = np.zeros((100 * fine, 200 * fine), np.float32)
        ends = [np.round(np.array(corners) * fine * 16).astype(np.int32)]
        cv2.fillPoly(drawn, ends, 1.0, shift=4)
        return np.asarray(drawn)

    shaft = [[30, 50 - half], [point, 50 - half], [point - length, 50 + half], [30, 50 + half]]
    dark = filled(shaft)
    begin = point - length
    dark -= (1.0 - face) * dark * filled([[begin, 40], [160, 40], [160, 60], [begin, 60]])
    beside = filled([[30, 50 + half], [point, 50 + half], [point, 56], [30, 56]])
    dark = np.where(beside > 0.0, np.maximum(dark, shade), dark)
    cover = cv2.GaussianBlur(
        cv2.resize(dark, (200, 100), interpolation=cv2.INTER_AREA), (0, 0), blur
    )
    rng = np.random.default_rng(seed)
    image = np.clip(np.round(170 - 110 * cover + rng.normal(0, 2, cover.shape)), 0, 255)
    return image.astype(np.uint8), point - 0.5


@pytest.mark.parametrize("face", [-0.8, 0.5, 0.7, 1.0])
@pytest.mark.parametrize("blur", [0.5, 1.0])
def test_where_a_bevel_ends_is_as_uncertain_as_its_face_makes_it(face: float, blur: float) -> None:
    for length in (5.0, 8.0):
        image, end = drawn_end(length, face, 0.0, blur, 1)
        expected = Expected(np.array([138.0, 49.5]), np.array([1.0, 0.0]), 90.0, 6, 0.0)
        tip = fit_expected(image, expected, False, DetectionSettings())
        assert tip is not None
        assert abs(tip.point[0] - end) < 4.0 * tip.sigma_along
    # A flat end is what it was.
    image, end = drawn_end(0.0, 1.0, 0.0, blur, 1)
    flat = fit_expected(image, expected, False, DetectionSettings())
    assert flat is not None
    assert flat.sigma_along < 0.2
    assert abs(flat.point[0] - end) < 3.0 * flat.sigma_along


@pytest.mark.parametrize("shade", [0.3, 0.45])
def test_a_shade_along_one_side_makes_the_line_less_certain(shade: float) -> None:
    expected = Expected(np.array([138.0, 49.5]), np.array([1.0, 0.0]), 90.0, 6, 0.0)
    image, _ = drawn_end(0.0, 1.0, shade, 0.8, 2)
    tip = fit_expected(image, expected, False, DetectionSettings())
    plain, _ = drawn_end(0.0, 1.0, 0.0, 0.8, 2)
    alone = fit_expected(plain, expected, False, DetectionSettings())
    assert tip is not None
    assert alone is not None
    assert alone.sigma_across < 0.08
    assert tip.sigma_across > 2.0 * alone.sigma_across
    assert abs(tip.point[1] - 49.5) < 3.5 * tip.sigma_across


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
