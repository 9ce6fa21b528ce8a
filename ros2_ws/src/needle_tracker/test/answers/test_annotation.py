"""Answers as a picture and as a message: reasons, counts, orientation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drawn_needles import arc
from needle_tracker.answers.annotation import annotate, describe, describe_view, missing
from needle_tracker.answers.run_summary import DetectionCounts
from needle_tracker.answers.track_images import COLUMNS, to_row
from needle_tracker.answers.tracker_messages import (
    ROLL_VARIANCE,
    orientation,
    picture_message,
    rotation_covariance,
)
from needle_tracker.detector.end_fit import ImageEnd
from needle_tracker.filter.measurement import Measurement, NoTip, TrackState
from needle_tracker.filter.needle_tracker import NeedleTracker
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.tracker_parameters import StereoTrackerParameters


def test_tip_and_state_are_drawn_at_their_pixels(
    calibration: StereoCalibration,
    settings: StereoTrackerParameters,
    draw_pair: Callable[..., tuple[np.ndarray, np.ndarray]],
) -> None:
    tracker = NeedleTracker(calibration, settings)
    left, right = draw_pair(arc(0.05, 5.0, 1.0))
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


END = ImageEnd(np.array([300.0, 200.0]), np.array([1.0, 0.0]), 0.3, 1.0, 0.01, 0.93, 0.98)
HIDDEN = dataclasses.replace(END, ends=0.2)


def nothing(left: ImageEnd | None, right: ImageEnd | None) -> Measurement:
    return Measurement(None, TrackState.SEARCHING, NoTip.NOTHING, (left, right))


@pytest.mark.parametrize(
    ("left", "right", "cause"),
    [
        (None, HIDDEN, "no needle seen"),
        (END, HIDDEN, "end seen in the left view only"),
        (None, END, "end seen in the right view only"),
        (END, END, "both views show an end but they do not meet"),
    ],
)
def test_the_reason_for_no_tip_depends_on_the_views(
    left: ImageEnd | None, right: ImageEnd | None, cause: str
) -> None:
    measured = nothing(left, right)
    assert missing(measured) == cause
    row = dict(zip(COLUMNS, to_row("a", measured), strict=True))
    assert (row["valid"], row["missing"]) == ("0", cause)
    seen = {None: ("", ""), END: ("0.93", "0.98"), HIDDEN: ("0.20", "0.98")}
    assert (row["left_end"], row["left_shaft"]) == seen[left]
    assert (row["right_end"], row["right_shaft"]) == seen[right]


def test_counts_include_all_processed_pairs() -> None:
    counts = DetectionCounts()
    for measured in (
        *[nothing(END, HIDDEN)] * 3,
        Measurement(None, TrackState.CONFIRMING, NoTip.UNCONFIRMED, (END, END)),
        *[Measurement(None, TrackState.ENTRY, "")] * 5,
    ):
        counts.add(measured)
    lines = counts.describe().splitlines()
    assert lines[0].endswith("left : end seen in 4 of 4 pairs, shaft in 4")
    assert lines[1].endswith("right: end seen in 1 of 4 pairs, shaft in 4")
    assert lines[2].endswith("5 x  in the entry zone")
    assert counts.figures()["right_end_seen"] == 1


def test_pictures_describe_each_view() -> None:
    grey = np.full((480, 640), 128, np.uint8)
    assert (describe_view(None), describe_view(END)) == ("nothing found", "end 0.93, shaft 0.98")
    below = annotate(grey, grey, nothing(END, None))[240:262]
    other = annotate(grey, grey, nothing(END, END))[240:262]
    assert np.array_equal(below[:, :320], other[:, :320])
    assert not np.array_equal(below[:, 322:], other[:, 322:])


def directions() -> np.ndarray:
    drawn = np.random.default_rng(0).normal([0.0, 0.0, 2.0], 1.0, (50, 3))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True))


def test_z_axis_is_the_shaft_and_roll_is_zero() -> None:
    for d in directions():
        rotation = Rotation.from_quat(orientation(d))
        np.testing.assert_allclose(rotation.apply([0.0, 0.0, 1.0]), d, atol=1e-12)
        gamma = rotation.as_euler("XYZ")[2]
        assert abs(gamma) < 1e-9


def test_rotations_of_the_covariance_spread_the_direction() -> None:
    rng = np.random.default_rng(1)
    for d in directions()[:5]:
        across = np.eye(3) - np.outer(d, d)
        root = 0.02 * across @ rng.normal(size=(3, 3))
        wanted = root @ root.T
        covariance = rotation_covariance(d, wanted)
        np.testing.assert_allclose(d @ covariance @ d, ROLL_VARIANCE)
        small = covariance - ROLL_VARIANCE * np.outer(d, d)
        turns = rng.multivariate_normal(np.zeros(3), small, 4000, method="eigh")
        moved = Rotation.from_rotvec(turns).apply(d) - d
        np.testing.assert_allclose(np.cov(moved.T), wanted, atol=0.12 * np.abs(wanted).max())
