"""What an end that is not like the needle is worth."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import pytest

from needle_tracker.image.tip_fit import ImageTip
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.tracking.evidence import (
    VisibilityAverage,
    is_sound,
    sights_to_confirm,
)
from needle_tracker.tracking.measurement import Measurement, judged
from needle_tracker.tracking.refusals import TrackState
from needle_tracker.tracking.tracker import StereoTracker
from needle_tracker.tracking.tracker_settings import TrackerSettings

from .seen import AHEAD, GOOD, Views, established, tip


def test_what_stands_out_more_than_the_needle_can_must_be_seen_again() -> None:
    waiting = functools.partial(sights_to_confirm, alike=False, near=True, guided=False, come=False)
    for state in (TrackState.TRACKING, TrackState.CONFIRMING):
        assert waiting(state, (GOOD, GOOD), possible=True) == 0
        assert waiting(state, (GOOD, GOOD), possible=False) == 2


@pytest.mark.parametrize("plainer", [1.0, 1.6])
def test_a_tip_too_plain_for_the_needle_is_not_believed_at_once(
    settings: TrackerSettings, calibration: StereoCalibration, views: Views, plainer: float
) -> None:
    tracker = StereoTracker(calibration, settings)
    tracker.track.__dict__.update(established(settings).__dict__)
    tracker._acquisition._usual.see((GOOD, GOOD))
    ends: list[ImageTip] = []
    for view in views:
        along = view.jacobian(tip().position) @ AHEAD
        end = dataclasses.replace(GOOD, point=view.project(np.array([0.0, 0.0, 0.072])))
        end = dataclasses.replace(end, direction=along / np.linalg.norm(along))
        ends.append(dataclasses.replace(end, visibility=plainer * GOOD.visibility))
    found = (ends[0], ends[1])
    measured = judged(views, tracker.track, found, 0.072)
    assert measured.tip is not None
    assert not tracker.track.fits(measured.tip, 0.072, on_way=False)
    wanted = tracker._acquisition._sights_wanted(measured, found, 0.072, on_way=False)
    assert wanted == (0 if plainer == 1.0 else 2)


def test_what_begins_at_the_entry_is_no_needle_that_has_begun(
    settings: TrackerSettings, calibration: StereoCalibration
) -> None:
    tracker = StereoTracker(calibration, settings)
    young = tip(z=0.01)
    measured = Measurement(young, TrackState.SEARCHING, "", (GOOD, GOOD))
    assert tracker._acquisition._begins_at_entry(measured, 0.01)
    # Disturbed, and plainer in one view than in the other.
    disturbed = dataclasses.replace(GOOD, sigma_across=0.4)
    for plainer, believed in ((1.3, True), (1.7, False)):
        other = dataclasses.replace(GOOD, visibility=plainer * GOOD.visibility)
        for found in ((disturbed, other), (other, disturbed)):
            unlike = dataclasses.replace(measured, image_tips=found)
            assert tracker._acquisition._begins_at_entry(unlike, 0.01) is believed
    assert tracker.track.accept(young, 0.01) is not None
    assert not tracker._acquisition._begins_at_entry(measured, 0.01)


@pytest.mark.parametrize("plainer", [0.8, 1.3])
def test_a_line_that_is_unlike_and_disturbed_may_be_half_another_s(plainer: float) -> None:
    """Half a shadow's where it is fainter than the needle, half a cable's where it is plainer."""
    usual = VisibilityAverage()
    unlike = dataclasses.replace(GOOD, visibility=plainer * GOOD.visibility)
    mixed = dataclasses.replace(unlike, sigma_across=0.4)
    assert usual.unmixed((mixed, GOOD)) == (mixed, GOOD)
    usual.see((GOOD, GOOD))
    disturbed = dataclasses.replace(GOOD, sigma_across=0.4)
    assert usual.unmixed((unlike, disturbed)) == (unlike, disturbed)
    for shown in (usual.unmixed, usual.doubted):
        left, right = shown((mixed, GOOD))
        assert left.sigma_across == pytest.approx(math.hypot(0.4, 2.0))
        assert right == GOOD


def test_what_lies_over_the_needle_is_not_like_it() -> None:
    usual = VisibilityAverage()
    assert usual.is_like((GOOD, GOOD))
    usual.see((GOOD, GOOD))
    assert usual.is_like((dataclasses.replace(GOOD, visibility=0.5), GOOD))
    assert not usual.is_like((dataclasses.replace(GOOD, visibility=0.95), GOOD))
    for _ in range(30):
        usual.see((dataclasses.replace(GOOD, visibility=0.95), GOOD))
    assert usual.is_like((dataclasses.replace(GOOD, visibility=0.95), GOOD))


def test_where_the_needle_must_be_light_on_it_is_allowed_and_something_over_it_is_not() -> None:
    usual = VisibilityAverage()
    usual.see((GOOD, GOOD))

    def allowed(share: float, sigma: float) -> bool:
        other = dataclasses.replace(GOOD, visibility=share * GOOD.visibility, sigma_across=sigma)
        assert usual.allows((other, GOOD)) is usual.allows((GOOD, other))
        return usual.allows((other, GOOD))

    assert allowed(0.5, 0.05)
    assert allowed(0.5, 0.5)
    assert not allowed(0.3, 0.05)
    # Plainer, only if nothing disturbs its line.
    assert allowed(1.35, 0.05)
    assert not allowed(1.35, 0.5)
    assert not allowed(1.5, 0.05)


def test_how_much_light_there_is_says_nothing() -> None:
    dim = dataclasses.replace(GOOD, contrast=GOOD.contrast / 4.0)
    usual = VisibilityAverage()
    usual.see((GOOD, GOOD))
    assert usual.is_like((dim, GOOD))
    assert is_sound((dim, GOOD), 0.3, 2.0)
    shadow = dataclasses.replace(GOOD, visibility=GOOD.visibility / 2.5)
    assert not usual.is_like((shadow, GOOD))
    assert not is_sound((shadow, GOOD), 0.3, 2.0)


def test_what_is_unlike_the_needle_hardly_says_where_it_is() -> None:
    usual = VisibilityAverage()
    unlike = dataclasses.replace(GOOD, visibility=0.95)
    assert usual.doubted((unlike, GOOD)) == (unlike, GOOD)
    usual.see((GOOD, GOOD))
    assert usual.doubted((GOOD, GOOD)) == (GOOD, GOOD)
    left, right = usual.doubted((unlike, GOOD))
    assert left.sigma_across > 20.0 * GOOD.sigma_across
    assert left.sigma_along == GOOD.sigma_along
    assert right == GOOD
