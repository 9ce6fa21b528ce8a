"""Where something crosses the needle in one view, the other one guides."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import cv2
import numpy as np
import pytest

from needle_tracker.image.tip_fit import ImageTip, fit_tip, hidden
from needle_tracker.optics.calibration import SIDES
from needle_tracker.tracking import acquisition
from needle_tracker.tracking import tracker as following_tracker
from needle_tracker.tracking.evidence import VisibilityAverage
from needle_tracker.tracking.measurement import Measurement
from needle_tracker.tracking.refusals import NoTip, TrackState
from needle_tracker.tracking.tracker import StereoTracker

from .shown_needle import Arc, Drawer, Image, Views, last_seen


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
