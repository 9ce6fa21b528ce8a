"""A needle that one camera does not see, and one that is short and badly seen."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from needle_core.diagnostics import Level
from needle_tracker.answers.annotation import describe
from needle_tracker.answers.health import Health
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.tracking.acquisition import Acquisition
from needle_tracker.tracking.measurement import Measurement
from needle_tracker.tracking.refusals import NoTip, TrackState
from needle_tracker.tracking.single_view import seen_alone
from needle_tracker.tracking.tip_prediction import Anchor, TipMotion
from needle_tracker.tracking.tracker import EACH_VIEW, ONE_VIEW, StereoTracker
from needle_tracker.tracking.tracker_settings import TrackerSettings
from needle_tracker.tracking.triangulation import SpatialTip

Drawer = Callable[..., tuple[np.ndarray, np.ndarray]]
Arc = Callable[..., np.ndarray]
BELIEVED = SpatialTip(
    np.array([0.0, 0.0, 0.05]),
    1e-10 * np.eye(3),
    np.array([0.0, 0.0, 1.0]),
    np.diag([1e-4, 1e-4, 0.0]),
    1e-3,
    0.5,
)


@pytest.fixture
def tracker(settings: TrackerSettings, calibration: StereoCalibration) -> StereoTracker:
    gates = dataclasses.replace(settings.gates, lost_after=10)
    return StereoTracker(calibration, dataclasses.replace(settings, gates=gates))


@pytest.mark.parametrize("blocked", [0, 1])
@pytest.mark.parametrize("cover", [0, 90])
def test_one_view_keeps_up_with_a_needle_that_the_other_does_not_see(
    tracker: StereoTracker, draw_pair: Drawer, make_arc: Arc, blocked: int, cover: int
) -> None:
    """For 11 mm one camera is black, or sees a hand, all of one grey.

    A hand leaves a tip, as long as its place is known well; a black image never does.
    """
    tips = []
    for mm in range(43, 53):
        assert tracker.process(*draw_pair(make_arc(mm * 1e-3, 6.0, 1.0)), mm * 1e-3).tip is not None
    for mm in range(53, 64):
        path = make_arc(mm * 1e-3, 6.0, 1.0)
        pair = list(draw_pair(path))
        pair[blocked] = np.full_like(pair[blocked], cover)
        measured = tracker.process(pair[0], pair[1], mm * 1e-3)
        if measured.tip is not None:
            tips.append(mm)
            assert measured.state is TrackState.TRACKING
            assert measured.reason.startswith(ONE_VIEW)
            assert [tip is None for tip in measured.image_tips] == [blocked == 0, blocked == 1]
            error = measured.tip.position - path[-1]
            assert np.linalg.norm(error) < 1e-3
            assert error @ np.linalg.solve(measured.tip.covariance, error) < 12.0
            # As the path is drawn, the shaft runs along it.
            way = path[-1] - path[-6]
            lean = measured.tip.direction - way / np.linalg.norm(way)
            spread = measured.tip.direction_covariance + 1e-6 * np.eye(3)
            assert lean @ np.linalg.solve(spread, lean) < 12.0
        anchor = tracker.track.anchor
        assert anchor is not None
        assert anchor.insertion == mm * 1e-3
        off = anchor.motion.position - path[-1]
        seen = tracker.views[1 - blocked].jacobian(path[-1]) @ off
        assert np.linalg.norm(seen) < 1.5
        assert off @ np.linalg.solve(anchor.motion.covariance[:3, :3], off) < 25.0
    assert tracker.track.state is TrackState.LOST
    assert tips == (list(range(53, 53 + len(tips))) if cover else [])
    assert not cover or 4 <= len(tips) <= 9
    path = make_arc(0.064, 6.0, 1.0)
    found = tracker.process(*draw_pair(path), 0.064)
    assert found.tip is not None
    assert np.linalg.norm(found.tip.position - path[-1]) < 0.2e-3


def test_a_needle_that_may_be_another_is_not_seen_by_one_view(
    tracker: StereoTracker, draw_pair: Drawer, make_arc: Arc
) -> None:
    """It is shown by both views ten times, or it is not known what the one view shows."""
    left, right = draw_pair(make_arc(0.05, 6.0, 1.0))
    blocked = np.full_like(right, 90)
    for count in (9, 10):
        tracker.reset()
        for _ in range(count):
            assert tracker.process(left, right, 0.05).tip is not None
        assert (tracker.process(left, blocked, 0.05).tip is not None) is (count == 10)


def test_one_view_goes_on_as_long_as_the_depth_is_known(settings: TrackerSettings) -> None:
    known = []
    reach = dataclasses.replace(settings.gates.reach, curvature=9.0)
    gates = dataclasses.replace(settings.gates, reach=reach, max_depth_sigma=0.3e-3)
    motion, unseen = TipMotion.start(BELIEVED), 0.0
    for _ in range(14):
        motion, unseen = motion.advanced(1e-3, 9.0, unseen), unseen + 1e-3
        predicted = Anchor(motion, 0.06, 1e-3, True, unseen)
        # One view says all but the depth.
        motion = motion.taken_in(np.zeros(2), np.eye(3)[1:], 1e-10 * np.eye(2))
        tip = seen_alone(predicted, motion, BELIEVED, gates)
        known.append(tip is not None)
        if tip is not None:
            assert predicted.motion.sigma <= gates.max_depth_sigma
            assert tip.position is motion.position
            assert tip.disagreement == tip.disagreement_across == 0.0
            np.testing.assert_array_equal(tip.direction, BELIEVED.direction)
            turned = np.sqrt(np.diag(tip.direction_covariance - BELIEVED.direction_covariance))
            np.testing.assert_allclose(turned, [9.0 * unseen, 9.0 * unseen, 0.0])
    # Once it is not, it stays so.
    assert known == sorted(known, reverse=True)
    assert known[0]
    assert not known[-1]


def test_a_tip_of_one_view_is_told_as_such(
    tracker: StereoTracker, draw_pair: Drawer, make_arc: Arc
) -> None:
    pair = list(draw_pair(make_arc(0.05, 6.0, 1.0)))
    health = Health()
    for number in range(11):
        if number == 10:
            pair[1] = np.full_like(pair[1], 90)
        measured = tracker.process(pair[0], pair[1], 0.05)
        health.pair_done(0.0, 0.01, measured)
    assert describe(measured).endswith("mm (one view alone, no needle in the right image)")
    told = health.track()
    assert told.level is Level.WARN
    assert told.message == "TRACKING: one view alone, no needle in the right image"
    assert (told.values["tips"], told.values["tips of single views"]) == ("11", "1")


def test_views_that_only_one_by_one_show_the_needle_are_told_as_such(
    tracker: StereoTracker, draw_pair: Drawer, make_arc: Arc, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = make_arc(0.05, 6.0, 1.0)
    left, right = draw_pair(path)
    for _ in range(11):
        tracker.process(left, right, 0.05)
    nothing = Measurement(None, TrackState.TRACKING, "views do not meet")
    monkeypatch.setattr(tracker, "_follow", lambda *_: None)
    monkeypatch.setattr(Acquisition, "look", lambda *_: nothing)
    measured = tracker.process(left, right, 0.05)
    assert measured.tip is not None
    assert np.linalg.norm(measured.tip.position - path[-1]) < 0.1e-3
    assert measured.reason == f"{EACH_VIEW}, views do not meet"


@pytest.mark.parametrize("reason", [NoTip.TOO_FAR, NoTip.SURPRISING])
def test_what_both_views_show_elsewhere_is_not_outvoted_by_one(
    tracker: StereoTracker,
    draw_pair: Drawer,
    make_arc: Arc,
    monkeypatch: pytest.MonkeyPatch,
    reason: str,
) -> None:
    left, right = draw_pair(make_arc(0.05, 6.0, 1.0))
    for _ in range(11):
        tracker.process(left, right, 0.05)
    elsewhere = Measurement(None, TrackState.TRACKING, reason, contested=BELIEVED)
    monkeypatch.setattr(tracker, "_follow", lambda *_: elsewhere)
    assert tracker.process(left, right, 0.05).tip is None


def test_no_view_no_keeping_up(tracker: StereoTracker, draw_pair: Drawer, make_arc: Arc) -> None:
    for mm in range(40, 53):
        tracker.process(*draw_pair(make_arc(mm * 1e-3, 6.0, 1.0)), mm * 1e-3)
    empty = draw_pair(None)
    for mm in range(53, 60):
        tracker.process(*empty, mm * 1e-3)
    anchor = tracker.track.anchor
    assert anchor is not None
    assert anchor.insertion == pytest.approx(0.052)


@pytest.mark.parametrize("spoilt", [0, 1])
@pytest.mark.parametrize("trouble", ["longer", "hidden"])
def test_a_short_needle_whose_end_one_view_shows_is_found(
    tracker: StereoTracker, draw_pair: Drawer, make_arc: Arc, spoilt: int, trouble: str
) -> None:
    """In one view something goes on beyond the end, as a shadow does, or lies over it."""
    errors = []
    for mm in range(8, 12):
        path = make_arc(mm * 1e-3, 6.0, 1.0)
        pair = list(draw_pair(path, seed=mm))
        if trouble == "longer":
            longer = np.concatenate([path, path[-1:] + np.array([0.0, 0.0, 2.5e-3])])
            pair[spoilt] = draw_pair(longer, seed=mm)[spoilt]
        else:
            u, v = tracker.views[spoilt].project(path[-1]).round().astype(int)
            pair[spoilt][v - 9 : v + 10, u - 6 : u + 14] = 90
        tip = tracker.process(pair[0], pair[1], mm * 1e-3).tip
        if tip is not None:
            errors.append(float(np.linalg.norm(tip.position - path[-1])))
    assert len(errors) >= 2
    assert max(errors) < 0.5e-3
