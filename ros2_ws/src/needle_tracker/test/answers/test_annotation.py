"""The picture for a person."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from needle_tracker.answers.annotation import annotate, describe
from needle_tracker.answers.tracker_messages import picture_message
from needle_tracker.filter.measurement import Measurement, TrackState
from needle_tracker.filter.needle_tracker import NeedleTracker
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.tracker_parameters import StereoTrackerParameters


def test_tip_and_state_are_drawn_at_their_pixels(
    calibration: StereoCalibration,
    settings: StereoTrackerParameters,
    draw_pair: Callable[..., tuple[np.ndarray, np.ndarray]],
    make_arc: Callable[..., np.ndarray],
) -> None:
    tracker = NeedleTracker(calibration, settings)
    left, right = draw_pair(make_arc(0.05, 5.0, 1.0))
    for _ in range(2):
        measured = tracker.process(left, right, 0.05)
    picture = annotate(left, right, measured)
    assert picture.shape[1] == 1024 + 4
    red, green, blue = np.moveaxis(picture[:384].astype(int), 2, 0)
    coloured, shaft = np.ptp(picture[:384], axis=2) > 60, green - np.maximum(red, blue) > 60
    for side, tip in enumerate(measured.ends):
        assert tip is not None
        of_view = slice(side * 514, side * 514 + 512)
        for behind, is_shaft in ((4.0, True), (30.0, True), (-60.0, False)):
            u, v = np.rint((tip.point - behind * tip.direction) / 2).astype(int)
            assert shaft[:, of_view][v - 1 : v + 2, u - 1 : u + 2].any() == is_shaft
        v, u = np.nonzero(coloured[:, of_view])
        assert np.linalg.norm([u.mean(), v.mean()] - tip.point / 2) < 20.0
    assert describe(measured).startswith("TRACKING: x ")
    assert picture[390:].any()
    message = picture_message(picture, 5)
    assert (message.frame_id, message.stamp_ns) == ("left_camera_optical", 5)
    assert (message.step, len(message.data)) == (3 * picture.shape[1], picture.size)


def test_without_a_tip_the_reason_is_given() -> None:
    dark = np.zeros((768, 1024), np.uint8)
    measured = Measurement(None, TrackState.SEARCHING, "left image is black")
    assert describe(measured) == "SEARCHING: left image is black"
    assert not np.ptp(annotate(dark, dark, measured)[:384].astype(int), axis=2).any()
