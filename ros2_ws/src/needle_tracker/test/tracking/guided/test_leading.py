"""Where one view's end, or the entry, leads to in the other view."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from needle_tracker.image.search_grid import Reach
from needle_tracker.image.tip_fit import ImageTip, hidden
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracking import acquisition
from needle_tracker.tracking.following import Follower
from needle_tracker.tracking.guided_search import guided_pairs, predicted_from_entry
from needle_tracker.tracking.tip_prediction import Anchor, TipMotion
from needle_tracker.tracking.tracker import StereoTracker
from needle_tracker.tracking.tracker_settings import TrackerSettings

from .shown_needle import Arc, Drawer, Image, Views, last_seen


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
