"""A needle that one camera does not see, and one that is short and badly seen."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from needle_tracker.calibration import StereoCalibration
from needle_tracker.track import TrackState
from needle_tracker.tracker import StereoTracker
from needle_tracker.tracker_settings import TrackerSettings

Drawer = Callable[..., tuple[np.ndarray, np.ndarray]]
Arc = Callable[..., np.ndarray]


@pytest.fixture
def tracker(settings: TrackerSettings, calibration: StereoCalibration) -> StereoTracker:
    return StereoTracker(calibration, settings)


@pytest.mark.parametrize("blocked", [0, 1])
@pytest.mark.parametrize("cover", [0, 90])
def test_one_view_keeps_up_with_a_needle_that_the_other_does_not_see(
    tracker: StereoTracker, draw_pair: Drawer, make_arc: Arc, blocked: int, cover: int
) -> None:
    """For 15 mm one camera is black, or sees a hand, all of one grey."""
    for mm in range(40, 53):
        assert tracker.process(*draw_pair(make_arc(mm * 1e-3, 6.0, 1.0)), mm * 1e-3).tip is not None
    for mm in range(53, 68):
        path = make_arc(mm * 1e-3, 6.0, 1.0)
        pair = list(draw_pair(path))
        pair[blocked] = np.full_like(pair[blocked], cover)
        assert tracker.process(pair[0], pair[1], mm * 1e-3).tip is None
        anchor = tracker.track.anchor
        assert anchor is not None
        assert anchor.insertion == mm * 1e-3
        off = anchor.motion.position - path[-1]
        seen = tracker.views[1 - blocked].jacobian(path[-1]) @ off
        assert np.linalg.norm(seen) < 1.5
        assert off @ np.linalg.solve(anchor.motion.covariance[:3, :3], off) < 25.0
    assert tracker.track.state is TrackState.LOST
    path = make_arc(0.068, 6.0, 1.0)
    found = tracker.process(*draw_pair(path), 0.068)
    assert found.tip is not None
    assert np.linalg.norm(found.tip.position - path[-1]) < 0.2e-3


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
