"""Where something crosses the needle in one view, the other one guides."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from needle_tracker.answers.tracker_parameters import default_settings
from needle_tracker.image.search_grid import Reach
from needle_tracker.image.tip_fit import ImageTip, fit_tip, hidden
from needle_tracker.optics.calibration import SIDES, StereoCalibration
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracking import acquisition
from needle_tracker.tracking import tracker as following_tracker
from needle_tracker.tracking.evidence import VisibilityAverage
from needle_tracker.tracking.following import Follower
from needle_tracker.tracking.guided_search import guided_pairs, predicted_from_entry
from needle_tracker.tracking.measurement import Measurement
from needle_tracker.tracking.refusals import NoTip
from needle_tracker.tracking.tip_prediction import Anchor, TipMotion
from needle_tracker.tracking.track import TrackState
from needle_tracker.tracking.tracker import StereoTracker
from needle_tracker.tracking.tracker_settings import TrackerSettings

Image = np.ndarray
Drawer = Callable[..., tuple[Image, Image]]
Arc = Callable[..., np.ndarray]
Views = tuple[RefractedCamera, RefractedCamera]


@pytest.fixture
def tracker(calibration: StereoCalibration) -> StereoTracker:
    return StereoTracker(calibration, default_settings(calibration))


def with_cable(image: Image, pixel: np.ndarray, degrees: float) -> Image:
    """Return an image with a long dark line through a pixel, as wide as a needle."""
    angle = math.radians(degrees)
    way = 400.0 * np.array([math.cos(angle), math.sin(angle)])
    first, second = (np.round(16.0 * (pixel + sign * way)).astype(int) for sign in (-1, 1))
    drawn: Image = image.copy()
    cv2.line(drawn, tuple(first.tolist()), tuple(second.tolist()), (60,), 4, cv2.LINE_AA, 4)
    return drawn


def crossed(
    views: Views, pair: tuple[Image, Image], path: np.ndarray, crossing: tuple[int, float, float]
) -> tuple[Image, Image]:
    """Return a pair with a cable in one view, at an angle and so many metres before the tip."""
    side, degrees, before = crossing
    images = list(pair)
    nearest = np.argmin(np.abs(np.linalg.norm(path - path[-1], axis=1) - before))
    images[side] = with_cable(images[side], views[side].project(path[nearest]), degrees)
    return images[0], images[1]


@pytest.fixture(scope="module")
def shown(draw_pair: Drawer, make_arc: Arc) -> list[tuple[Image, Image]]:
    """Return pairs of a needle from 40 to 52 mm."""
    return [draw_pair(make_arc(mm * 1e-3, 6.0, 1.0)) for mm in range(40, 53)]


def last_seen(tracker: StereoTracker, shown: list[tuple[Image, Image]], *, until: int = 60) -> None:
    """Show a needle up to 52 mm, and then hands."""
    for mm, pair in enumerate(shown, 40):
        assert tracker.process(*pair, mm * 1e-3).tip is not None
    covered = np.full((768, 1024), 90, np.uint8)
    for mm in range(53, until + 1):
        assert tracker.process(covered, covered, mm * 1e-3).tip is None


@pytest.mark.parametrize("crossing", [(0, -14.0, 5e-3), (1, -20.0, 5e-3), (1, 35.0, 5e-3)])
@pytest.mark.parametrize("guiding", [True, False])
def test_a_cable_across_one_view_does_not_keep_the_needle_from_being_found_again(
    tracker: StereoTracker,
    views: Views,
    draw_pair: Drawer,
    make_arc: Arc,
    shown: list[tuple[Image, Image]],
    monkeypatch: pytest.MonkeyPatch,
    crossing: tuple[int, float, float],
    guiding: bool,
) -> None:
    """Hands hide the needle for 8 mm; then a cable crosses it, near its end, in one view."""
    if not guiding:
        # That is what the search along paths makes of it.
        monkeypatch.setattr(acquisition, "guided_pairs", lambda *_: iter(()))
    last_seen(tracker, shown)
    for mm in range(61, 64):
        path = make_arc(mm * 1e-3, 6.0, 1.0)
        pair = crossed(views, draw_pair(path), path, crossing)
        measured = tracker.process(*pair, mm * 1e-3)
        if guiding:
            assert measured.tip is not None
            assert np.linalg.norm(measured.tip.position - path[-1]) < 0.1e-3
        elif mm == 61:
            assert measured.tip is None


@pytest.mark.parametrize("crossing", [(1, 20.0, 5e-3), (1, 14.0, 4e-3), (0, 20.0, 3e-3)])
def test_a_cable_along_the_needle_s_end_is_not_taken_for_it(
    tracker: StereoTracker,
    views: Views,
    draw_pair: Drawer,
    make_arc: Arc,
    shown: list[tuple[Image, Image]],
    crossing: tuple[int, float, float],
) -> None:
    """Twice as dark as the needle was: two lines that run together."""
    last_seen(tracker, shown)
    for mm in range(61, 65):
        path = make_arc(mm * 1e-3, 6.0, 1.0)
        tip = tracker.process(*crossed(views, draw_pair(path), path, crossing), mm * 1e-3).tip
        assert tip is None or np.linalg.norm(tip.position - path[-1]) < 1.5e-3


@pytest.mark.parametrize("plainer", [1.0, 2.0])
def test_the_place_where_the_needle_should_be_is_looked_at(
    tracker: StereoTracker,
    draw_pair: Drawer,
    make_arc: Arc,
    shown: list[tuple[Image, Image]],
    monkeypatch: pytest.MonkeyPatch,
    plainer: float,
) -> None:
    """Though the search along paths finds nothing; what is too plain is not the needle."""
    last_seen(tracker, shown, until=57)
    usual = tracker._usual._levels
    assert usual is not None
    tracker._usual._levels = (usual[0] / plainer, usual[1] / plainer)
    nothing = Measurement(None, TrackState.TRACKING, "no needle")
    monkeypatch.setattr(acquisition, "guided_pairs", lambda *_: iter(()))
    monkeypatch.setattr(acquisition.Acquisition, "_search", lambda *_, **__: nothing)
    monkeypatch.setattr(StereoTracker, "_follow", lambda *_: None)
    path = make_arc(0.058, 6.0, 1.0)
    measured = tracker.process(*draw_pair(path), 0.058)
    assert (measured.tip is not None) is (plainer == 1.0)
    if measured.tip is not None:
        assert measured.reason == ""
        assert np.linalg.norm(measured.tip.position - path[-1]) < 0.1e-3
        assert None not in measured.regions


@pytest.mark.parametrize("by", ["_search", "_where_expected"])
def test_a_line_that_may_be_half_a_shadow_s_says_little_however_it_is_found(
    tracker: StereoTracker,
    draw_pair: Drawer,
    make_arc: Arc,
    shown: list[tuple[Image, Image]],
    monkeypatch: pytest.MonkeyPatch,
    by: str,
) -> None:
    nothing = {
        "_search": Measurement(None, TrackState.TRACKING, "no needle"),
        "_where_expected": None,
    }
    other = next(name for name in nothing if name != by)
    pair = draw_pair(make_arc(0.058, 6.0, 1.0))

    def sigma(across_px: float | None) -> float:
        tracker.reset()
        last_seen(tracker, shown, until=57)
        with monkeypatch.context() as patch:
            patch.setattr(acquisition, "guided_pairs", lambda *_: iter(()))
            patch.setattr(acquisition.Acquisition, other, lambda *_, **__: nothing[other])
            patch.setattr(StereoTracker, "_follow", lambda *_: None)
            if across_px is not None:
                patch.setattr(
                    VisibilityAverage,
                    "unmixed",
                    lambda _, tips: tuple(
                        dataclasses.replace(tip, sigma_across=across_px) for tip in tips
                    ),
                )
            measured = tracker.process(*pair, 0.058)
        if measured.tip is None or measured.reason:
            return math.inf
        return float(np.sqrt(np.linalg.eigvalsh(measured.tip.covariance)[-1]))

    assert sigma(2.0) > 2.0 * sigma(None)


@pytest.mark.parametrize("blind", [0, 1])
def test_one_view_leads_to_the_other_though_the_search_finds_nothing_there(
    tracker: StereoTracker,
    draw_pair: Drawer,
    make_arc: Arc,
    shown: list[tuple[Image, Image]],
    monkeypatch: pytest.MonkeyPatch,
    blind: int,
) -> None:
    """Of what it finds in the view that leads, the end that is seen well counts."""
    last_seen(tracker, shown)
    paths = acquisition.Acquisition._paths
    monkeypatch.setattr(acquisition.Acquisition, "_paths", lambda *rest: 2 * paths(*rest))
    monkeypatch.setattr(acquisition.Acquisition, "_where_expected", lambda *_: None)
    monkeypatch.setattr(StereoTracker, "_follow", lambda *_: None)
    for mm in (61, 62):
        path = make_arc(mm * 1e-3, 6.0, 1.0)
        pair = draw_pair(path)
        fitted: list[ImageTip] = []

        def fit(
            image: Image,
            *rest: Any,
            spoilt: Image = pair[blind],
            fitted: list[ImageTip] = fitted,
        ) -> ImageTip | None:
            tip = fit_tip(image, *rest)
            if tip is None or np.array_equal(image, spoilt):
                return None
            fitted.append(tip)
            return hidden(tip) if len(fitted) == 1 else tip

        monkeypatch.setattr(acquisition, "fit_tip", fit)
        measured = tracker.process(*pair, mm * 1e-3)
        assert len(fitted) == 2
    assert measured.tip is not None
    assert np.linalg.norm(measured.tip.position - path[-1]) < 0.1e-3
    # What the search itself makes of it.
    monkeypatch.setattr(acquisition, "guided_pairs", lambda *_: iter(()))
    measured = tracker.process(*pair, 62e-3)
    assert measured.reason.endswith(f"no clear tip in the {SIDES[blind]} image")


@pytest.mark.parametrize("until", [52, 54])
def test_after_a_gap_what_following_leaves_uncertain_is_searched_for(
    tracker: StereoTracker,
    draw_pair: Drawer,
    make_arc: Arc,
    shown: list[tuple[Image, Image]],
    monkeypatch: pytest.MonkeyPatch,
    until: int,
) -> None:
    last_seen(tracker, shown, until=until)
    monkeypatch.setattr(
        following_tracker,
        "judged",
        lambda _views, track, found, _: Measurement(None, track.state, NoTip.UNCERTAIN, found),
    )
    monkeypatch.setattr(following_tracker, "is_sound", lambda *_: False)
    mm = until + 1
    path = make_arc(mm * 1e-3, 6.0, 1.0)
    measured = tracker.process(*draw_pair(path), mm * 1e-3)
    if until == 52:
        assert measured.reason.endswith(NoTip.UNCERTAIN)
    else:
        assert measured.reason == ""
        assert measured.tip is not None
        assert np.linalg.norm(measured.tip.position - path[-1]) < 0.1e-3


@pytest.mark.parametrize("crossing", [(0, 25.0, 4e-3), (0, -25.0, 5e-3), (1, 20.0, 5e-3)])
def test_a_cable_across_a_short_needle_does_not_hide_it(
    tracker: StereoTracker,
    views: Views,
    draw_pair: Drawer,
    make_arc: Arc,
    crossing: tuple[int, float, float],
) -> None:
    for mm in range(9, 13):
        path = make_arc(mm * 1e-3, 6.0, 1.0, 0.06)
        pair = crossed(views, draw_pair(path), path, crossing)
        measured = tracker.process(*pair, mm * 1e-3)
        # One sight of what was never seen is not enough.
        assert (measured.tip is None) is (mm == 9)
        assert measured.state is (TrackState.CONFIRMING if mm == 9 else TrackState.TRACKING)
        if measured.tip is not None:
            assert np.linalg.norm(measured.tip.position - path[-1]) < 0.15e-3


@pytest.mark.parametrize("crossing", [(1, 15.0, 5.5e-3), (0, 10.0, 5e-3)])
def test_a_cable_along_a_short_needle_s_end_is_not_taken_for_it(
    tracker: StereoTracker,
    views: Views,
    draw_pair: Drawer,
    make_arc: Arc,
    crossing: tuple[int, float, float],
) -> None:
    """It lies where a needle can be, but shows itself darker in one view than in the other."""
    for mm in range(9, 15):
        path = make_arc(mm * 1e-3, 6.0, 1.0, 0.06)
        pair = crossed(views, draw_pair(path), path, crossing)
        tip = tracker.process(*pair, mm * 1e-3).tip
        assert tip is None or np.linalg.norm(tip.position - path[-1]) < 1.5e-3


@pytest.fixture
def follower(views: Views, tracker: StereoTracker, settings: TrackerSettings) -> Follower:
    return Follower(views, tracker._detection, settings.needle_width, settings.hole_clearance)


def image_tip(view: RefractedCamera, point: np.ndarray, way: np.ndarray) -> ImageTip:
    """Return how a view shows a needle's end well."""
    along = view.jacobian(point) @ way
    along /= np.linalg.norm(along)
    return ImageTip(view.project(point), along, 0.05, 0.15, 0.005, 90.0, 0.5)


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize(
    ("off", "pitch"), [((-3e-3, 0.0), 0.0), ((3e-3, 0.0), 0.4), ((0.0, 2.5e-3), 0.0)]
)
def test_one_view_s_end_leads_to_the_other_s(
    views: Views,
    follower: Follower,
    draw_pair: Drawer,
    make_arc: Arc,
    side: int,
    off: tuple[float, float],
    pitch: float,
) -> None:
    """However far the prediction is off, down or aside, the ends are those of one point."""
    path = make_arc(0.02, 6.0, 1.0, pitch)
    tip, way = path[-1], (path[-1] - path[-10]) / np.linalg.norm(path[-1] - path[-10])
    seen: list[ImageTip | None] = [None, None]
    seen[side] = image_tip(views[side], tip, way)
    straight = np.array([0.0, 0.0, 1.0])
    motion = TipMotion(tip + np.array([*off, 0.0]), straight, np.diag([2e-3**2] * 3 + [0.1**2] * 3))
    predicted = Anchor(motion, 0.02, known=True)
    images = list(draw_pair(path))
    ends = (seen[0], seen[1])
    pairs = list(guided_pairs(follower, (images[0], images[1]), predicted, ends, None))
    assert pairs
    for pair in pairs:
        assert pair[side] is seen[side]
        other = pair[1 - side]
        assert other.clear
        assert np.linalg.norm(other.point - views[1 - side].project(tip)) < 1.0
    # A line that does not end there is not the needle's end.
    images[1 - side] = draw_pair(make_arc(0.04, 6.0, 1.0, pitch))[1 - side]
    for pair in guided_pairs(follower, (images[0], images[1]), predicted, ends, None):
        assert pair[1 - side].clear


@pytest.mark.parametrize(
    ("moved", "turned", "plainer", "sigma", "believed"),
    [
        (0.0, 0.0, 1.0, 0.05, True),
        (0.8e-3, 0.0, 1.0, 0.05, True),
        (1.2e-3, 0.0, 1.0, 0.05, False),
        (0.0, 0.2, 1.0, 0.05, True),
        (0.0, 0.7, 1.0, 0.05, False),
        (0.0, 0.0, 1.6, 0.05, False),
        (0.0, 0.0, 0.8, 0.05, True),
        (0.0, 0.0, 1.0, 0.4, True),
        (0.0, 0.0, 0.8, 0.4, False),
    ],
    ids=[
        "fits",
        "apart",
        "far apart",
        "leaning",
        "pointing elsewhere",
        "too plain",
        "faint",
        "disturbed",
        "faint and disturbed",
    ],
)
def test_what_one_view_leads_to_must_fit(
    tracker: StereoTracker,
    views: Views,
    make_arc: Arc,
    shown: list[tuple[Image, Image]],
    monkeypatch: pytest.MonkeyPatch,
    moved: float,
    turned: float,
    plainer: float,
    sigma: float,
    believed: bool,
) -> None:
    last_seen(tracker, shown)
    path = make_arc(0.061, 6.0, 1.0)
    way = (path[-1] - path[-4]) / np.linalg.norm(path[-1] - path[-4])
    way = math.cos(turned) * way + math.sin(turned) * np.cross(way, [0.0, 1.0, 0.0])
    left = image_tip(views[0], path[-1], way)
    right = image_tip(views[1], path[-1] + moved * way, way)
    left = dataclasses.replace(left, visibility=plainer * left.visibility, sigma_across=sigma)
    monkeypatch.setattr(acquisition, "guided_pairs", lambda *_: iter([(left, right)]))
    predicted = tracker.track.predict(0.061)
    assert predicted is not None
    covered = np.full((768, 1024), 90, np.uint8)
    found = tracker._acquisition._guided((covered, covered), 0.061, (left, right), predicted, None)
    assert (found is not None and found.tip is not None) is believed


def test_what_is_not_sound_leads_nowhere(
    views: Views, follower: Follower, draw_pair: Drawer, make_arc: Arc
) -> None:
    path = make_arc(0.02, 6.0, 1.0)
    tip = ImageTip(views[0].project(path[-1]), np.array([1.0, 0.0]), 0.05, 0.15, 0.005, 90.0, 0.5)
    predicted = Anchor(
        TipMotion(path[-1], np.array([0.0, 0.0, 1.0]), 1e-6 * np.eye(6)), 0.02, known=True
    )
    images = draw_pair(path)
    spoilt = (dataclasses.replace(tip, sigma_across=0.4), dataclasses.replace(tip, sigma_along=4.5))
    for seen in (None, hidden(tip), *spoilt):
        assert not list(guided_pairs(follower, images, predicted, (seen, None), None))
    # How far along it the end is the other view may say.
    loose = dataclasses.replace(tip, sigma_along=3.5)
    assert list(guided_pairs(follower, images, predicted, (loose, None), None))


@pytest.mark.parametrize("length", [5e-3, 15e-3, 25e-3])
def test_the_entry_says_where_a_needle_can_have_got_to(make_arc: Arc, length: float) -> None:
    reach = Reach(curvature=9.0, entry_angle=math.radians(10), hole_tolerance=0.5e-3, length=0.15)
    predicted = predicted_from_entry(reach, length)
    assert predicted.known
    assert predicted.insertion == length
    for roll in (0.0, 2.0, 4.0):
        # Bent as far as can be, and tilted by one sigma.
        off = make_arc(length, 9.0, roll, math.radians(10))[-1] - predicted.motion.position
        covariance = predicted.motion.covariance[:3, :3]
        assert off @ np.linalg.solve(covariance, off) < 9.0
        aside = make_arc(length, 0.0, roll, math.radians(40))[-1] - predicted.motion.position
        assert aside @ np.linalg.solve(covariance, aside) > 9.0
