"""How much must be seen of a tip that was found without a prediction, and where it is sought."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable

import numpy as np
import pytest

from needle_tracker.image.corridor import within_corridor
from needle_tracker.image.search_grid import make_search_grid
from needle_tracker.image.tip_fit import ImageTip, hidden
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.tracking import acquisition
from needle_tracker.tracking.evidence import (
    VisibilityAverage,
    has_come,
    is_half_sound,
    look_alike,
    shows_lines,
    sights_to_confirm,
    sights_to_contradict,
    sights_to_exclude,
)
from needle_tracker.tracking.measurement import Measurement
from needle_tracker.tracking.refusals import TrackState
from needle_tracker.tracking.track import Track
from needle_tracker.tracking.tracker import StereoTracker
from needle_tracker.tracking.tracker_settings import TrackerSettings

from .seen import GOOD, POOR, Views, established, tip


@pytest.mark.parametrize("state", [TrackState.TRACKING, TrackState.LOST])
def test_what_contradicts_the_track_must_be_seen_again(state: TrackState) -> None:
    contradicting = functools.partial(sights_to_contradict, state, on_way=True, come=False)
    assert contradicting((GOOD, GOOD), alike=True) > 1
    unlike = contradicting((GOOD, GOOD), alike=False)
    assert unlike == (0 if state is TrackState.TRACKING else 3)
    long = dataclasses.replace(GOOD, sigma_along=2.5)
    assert contradicting((long, GOOD), alike=True) > 1
    longer = dataclasses.replace(GOOD, sigma_along=3.5)
    for found in ((GOOD, hidden(GOOD)), (POOR, GOOD), (longer, GOOD), (GOOD, None)):
        assert contradicting(found, alike=True) == 0


@pytest.mark.parametrize("state", list(TrackState))
def test_only_an_end_that_has_come_wins_in_one_sight_against_the_last_place(
    state: TrackState,
) -> None:
    new = dataclasses.replace(GOOD, come=True)
    contradicting = functools.partial(sights_to_contradict, state, alike=True, on_way=False)
    assert contradicting((new, new), come=True) == 1
    assert contradicting((new, new), come=False) > 1
    for found in ((new, GOOD), (new, hidden(new)), (new, None)):
        assert contradicting(found, come=True) != 1


def test_how_badly_a_line_may_be_known_grows_with_what_is_allowed_it() -> None:
    """Take what a line shows four times as badly of a map that may: it counts as much."""
    usual = VisibilityAverage()
    usual.see((GOOD, GOOD))
    for across in (0.05, 0.25, 0.5, 0.7, 0.9):
        line = dataclasses.replace(GOOD, sigma_across=across, visibility=0.33)
        wide = dataclasses.replace(line, sigma_across=4.0 * across, allowance=4.0)
        for seen in (
            look_alike,
            lambda *tips: shows_lines(tips),
            lambda *tips: is_half_sound(tips),
        ):
            assert seen(GOOD, wide) is seen(GOOD, line)
        assert usual.allows((GOOD, wide)) is usual.allows((GOOD, line))
        mixed = usual.unmixed((line, wide))
        assert mixed[1].sigma_across == pytest.approx(4.0 * mixed[0].sigma_across)


def test_what_has_come_is_new_in_both_views_and_seen_in_both() -> None:
    new = dataclasses.replace(GOOD, come=True)
    assert has_come((new, new))
    for other in (GOOD, hidden(new), dataclasses.replace(new, sigma_along=3.5), None):
        assert not has_come((new, other))
        assert not has_come((other, new))


def test_once_the_phantom_was_seen_empty_one_sight_finds_the_needle(
    settings: TrackerSettings, calibration: StereoCalibration
) -> None:
    tracker = StereoTracker(calibration, settings)
    kept = dataclasses.replace(POOR, come=True)
    new = dataclasses.replace(kept, all_new=True)

    def wanted(left: ImageTip, right: ImageTip) -> int | None:
        measured = Measurement(tip(), tracker.track.state, "", (left, right))
        return tracker._acquisition._sights_wanted(measured, (left, right), 0.05, on_way=False)

    assert wanted(new, new) == 0
    # What a first pair with a needle has had already may hide some of it.
    assert wanted(kept, kept) == wanted(new, kept) == 3
    assert wanted(new, dataclasses.replace(new, sigma_along=3.5)) is None
    # Later it is known where it is, and what comes may be a hand.
    tracker.track.__dict__.update(established(settings).__dict__)
    measured = Measurement(tip(x=0.004), tracker.track.state, "", (new, new))
    assert tracker._acquisition._sights_wanted(measured, (new, new), 0.06, on_way=False) != 0


def test_one_sight_will_do_where_the_needle_must_be_only() -> None:
    lost = TrackState.LOST
    waiting = functools.partial(sights_to_confirm, possible=True, guided=False, come=False)
    assert waiting(lost, (GOOD, GOOD), alike=True, near=True) == 0
    assert waiting(lost, (GOOD, GOOD), alike=True, near=False) == 2
    assert waiting(lost, (GOOD, GOOD), alike=False, near=True) == 3
    assert waiting(lost, (POOR, GOOD), alike=True, near=True) == 3
    # A line without an end is the shaft's or any other's.
    assert waiting(lost, (GOOD, hidden(GOOD)), alike=True, near=False) is None
    assert waiting(lost, (GOOD, hidden(GOOD)), alike=True, near=True) == 2


def test_one_end_that_leads_to_the_other_is_believed_the_second_time() -> None:
    found = (GOOD, dataclasses.replace(GOOD, sigma_across=0.4, sigma_along=3.0))
    waiting = functools.partial(
        sights_to_confirm, alike=True, possible=True, near=False, come=False
    )
    for state in (TrackState.TRACKING, TrackState.LOST):
        assert waiting(state, found, guided=True) == 2
        assert waiting(state, found, guided=False) != 2


def test_an_established_track_is_wrong_where_a_plain_needle_is_seen_elsewhere() -> None:
    plain = dataclasses.replace(GOOD, sigma_across=0.1)
    wanted = functools.partial(sights_to_exclude, alike=True)
    assert wanted(TrackState.LOST, (plain, plain)) == 4
    assert wanted(TrackState.TRACKING, (plain, plain)) is None
    for other in (dataclasses.replace(GOOD, sigma_across=0.2), hidden(plain), None):
        assert wanted(TrackState.LOST, (plain, other)) is None
    assert sights_to_exclude(TrackState.LOST, (plain, plain), alike=False) is None


def test_a_needle_that_was_mistaken_is_found_where_it_is(
    settings: TrackerSettings,
    calibration: StereoCalibration,
    draw_pair: Callable[..., tuple[np.ndarray, np.ndarray]],
    make_arc: Callable[..., np.ndarray],
) -> None:
    """Something else was followed for 10 mm; the needle is plain to see, but far from it."""
    tracker = StereoTracker(calibration, settings)
    for mm in range(43, 53):
        assert tracker.process(*draw_pair(make_arc(mm * 1e-3, 6.0, 1.0)), mm * 1e-3).tip is not None
    covered = np.full((768, 1024), 90, np.uint8)
    for mm in range(53, 57):
        tracker.process(covered, covered, mm * 1e-3)
    assert tracker.track.state is TrackState.LOST
    found: list[bool] = []
    for mm in range(57, 62):
        path = make_arc(mm * 1e-3, 6.0, -1.0)
        assert tracker.track.is_excluded(
            dataclasses.replace(tip(), position=path[-1]), mm * 1e-3
        ) is (not any(found))
        measured = tracker.process(*draw_pair(path), mm * 1e-3)
        found.append(measured.tip is not None)
        if measured.tip is not None:
            assert np.linalg.norm(measured.tip.position - path[-1]) < 0.2e-3
    assert found == [False, False, False, True, True]


def test_a_tip_that_points_elsewhere_is_not_the_one_that_is_waited_for(
    settings: TrackerSettings,
) -> None:
    track = established(settings)
    here = tip(z=0.061)
    assert track.expects(here, 0.061)
    assert track.fits(here, 0.061, on_way=True)
    for angle, goes_on in ((0.1, True), (0.7, False)):
        direction = np.array([math.sin(angle), 0.0, math.cos(angle)])
        turned = dataclasses.replace(here, direction=direction)
        assert track.expects(turned, 0.061) is goes_on
        assert track.fits(turned, 0.061, on_way=True) is goes_on


def test_a_line_is_enough_of_a_sight_to_bear_out_what_is_known() -> None:
    assert shows_lines((GOOD, hidden(POOR)))
    assert not shows_lines((GOOD, dataclasses.replace(GOOD, sigma_across=0.9)))
    assert not shows_lines((GOOD, None))


def test_a_tip_just_where_it_is_expected_is_told_from_one_beside(settings: TrackerSettings) -> None:
    track = established(settings)
    assert track.expects(tip(z=0.061), 0.061)
    assert not track.expects(tip(x=1e-3, z=0.061), 0.061)
    # After some way out of sight the same place is no surprise; in the end nothing is.
    assert track.expects(tip(x=1e-3, z=0.072), 0.072)
    assert not track.expects(tip(x=4e-3, z=0.075), 0.075)
    assert track.surprise(tip(x=1e-3, z=0.1), 0.1) < 1.0
    assert not track.expects(tip(x=1e-3, z=0.1), 0.1)
    assert track.surprise(tip(x=1e-3, z=0.061), 0.061) > track.surprise(tip(z=0.061), 0.061)
    assert not track.expects(tip(), None)
    assert track.fits(tip(z=0.061), 0.061, on_way=True)
    assert not track.fits(tip(z=0.06), None, on_way=True)
    assert Track(settings.gates).surprise(tip(), 0.05) == math.inf


def test_one_end_and_the_other_view_s_line_are_half_a_sight() -> None:
    line = hidden(GOOD)
    assert is_half_sound((GOOD, line))
    assert is_half_sound((line, GOOD))
    assert not is_half_sound((line, line))
    assert not is_half_sound((GOOD, dataclasses.replace(line, sigma_across=0.9)))
    assert not is_half_sound((GOOD, dataclasses.replace(line, visibility=0.25)))
    assert not is_half_sound((GOOD, None))


def test_what_one_pair_shows_twice_counts_once(settings: TrackerSettings) -> None:
    track = established(settings)
    assert [track.contest(tip(x=2e-3, z=0.06), 0.061, 2) for _ in range(4)] == [False] * 4
    track.miss()
    assert track.contest(tip(x=2e-3, z=0.061), 0.062, 2)


def test_rivals_win_in_a_row_or_not_at_all(settings: TrackerSettings) -> None:
    track = established(settings)
    track.contest(tip(x=2e-3, z=0.06), 0.061, 2)
    track.miss()
    track.miss()
    assert not track.contest(tip(x=2e-3, z=0.062), 0.063, 2)


def test_a_needle_seen_well_cannot_be_elsewhere(settings: TrackerSettings) -> None:
    track = established(settings)
    assert track.is_established
    assert track.is_excluded(tip(x=-8e-3, z=0.0605), 0.061)
    assert not track.is_excluded(tip(x=0.5e-3, z=0.061), 0.061)
    for _ in range(settings.gates.forget_after + 5):
        track.miss()
    assert track.anchor is not None
    fresh = Track(settings.gates)
    fresh.accept(tip(), 0.05)
    assert not fresh.is_excluded(tip(x=-8e-3, z=0.0505), 0.051)


def test_a_needle_drawn_back_leaves_its_way(settings: TrackerSettings) -> None:
    track = established(settings)
    way = track.way(0.0505)
    assert way is not None
    assert way[0][:, 2].max() == pytest.approx(0.0505, abs=1e-4)
    assert np.all(np.diff(way[0][:, 2]) > 0.0)


def test_the_corridor_keeps_the_needle_and_drops_what_is_beside_it(
    views: Views, settings: TrackerSettings, make_arc: Callable[..., np.ndarray]
) -> None:
    path = make_arc(0.09, 7.0, -0.8)
    way, half_widths = path[30::12], np.full(len(path[30::12]), 2e-3)
    for view in views:
        grid = make_search_grid(view, settings.gates.reach, first_distance=2e-3)
        narrowed = within_corridor(grid, view, way, half_widths)
        assert np.count_nonzero(narrowed.reachable) < 0.5 * np.count_nonzero(grid.reachable)
        for offset, kept in ((0.0, True), (1.5e-3, True), (-1.5e-3, True), (5e-3, False)):
            for point in view.project(way + np.array([0.0, offset, 0.0])):
                near = np.linalg.norm(narrowed.pixels - point, axis=-1)
                row, column = np.unravel_index(int(np.argmin(near)), near.shape)
                assert narrowed.reachable[row, column] == kept


def test_found_again_beside_another_line(
    settings: TrackerSettings,
    calibration: StereoCalibration,
    draw_pair: Callable[..., tuple[np.ndarray, np.ndarray]],
    make_arc: Callable[..., np.ndarray],
) -> None:
    """Both cameras blocked for 12 mm; then a second line, as long and as dark, is there, too."""
    tracker = StereoTracker(calibration, settings)
    for insertion in np.arange(0.040, 0.0521, 0.001):
        pair = draw_pair(make_arc(float(insertion), 4.0, 1.0))
        assert tracker.process(*pair, float(insertion)).tip is not None
    dark = np.full_like(pair[0], 30)
    for insertion in np.arange(0.053, 0.0641, 0.001):
        assert tracker.process(dark, dark, float(insertion)).tip is None
    found = []
    for insertion in (0.065, 0.066, 0.067):
        needle = make_arc(insertion, 4.0, 1.0)
        other = make_arc(insertion, 3.0, 2.5, math.radians(-6.0))
        left, right = (
            np.minimum(a, b) for a, b in zip(draw_pair(needle), draw_pair(other), strict=True)
        )
        measured = tracker.process(left, right, insertion)
        if measured.tip is not None:
            found.append(np.linalg.norm(measured.tip.position - needle[-1]))
    assert len(found) == 3
    assert max(found) < 0.3e-3


@pytest.mark.parametrize("spoilt", [0, 1])
@pytest.mark.parametrize("trouble", ["shorter", "fainter"])
def test_found_again_at_once_where_it_is_waited_for(
    settings: TrackerSettings,
    calibration: StereoCalibration,
    draw_pair: Callable[..., tuple[np.ndarray, np.ndarray]],
    make_arc: Callable[..., np.ndarray],
    spoilt: int,
    trouble: str,
) -> None:
    """Both cameras blocked for 12 mm; then one view shows less of the needle, or less clearly."""
    tracker = StereoTracker(calibration, settings)
    for insertion in np.arange(0.040, 0.0521, 0.001):
        pair = list(draw_pair(make_arc(float(insertion), 4.0, 1.0)))
        assert tracker.process(pair[0], pair[1], float(insertion)).tip is not None
    dark = np.full_like(pair[0], 90)
    for insertion in np.arange(0.053, 0.0641, 0.001):
        assert tracker.process(dark, dark, float(insertion)).tip is None
    needle = make_arc(0.065, 4.0, 1.0)
    pair = list(draw_pair(needle))
    if trouble == "shorter":
        pair[spoilt] = draw_pair(make_arc(0.0632, 4.0, 1.0))[spoilt]
    else:
        background = float(np.median(pair[spoilt]))
        faint = background + 0.6 * (pair[spoilt].astype(float) - background)
        pair[spoilt] = faint.round().astype(np.uint8)
    found = tracker.process(pair[0], pair[1], 0.065).tip
    assert found is not None
    assert np.linalg.norm(found.position - needle[-1]) < 0.4e-3


@pytest.mark.parametrize(
    ("insertion", "bow", "found"), [(0.012, 4.5e-3, True), (0.06, 11e-3, False)]
)
def test_how_long_a_short_shaft_is_its_ends_say(
    settings: TrackerSettings,
    calibration: StereoCalibration,
    draw_pair: Callable[..., tuple[np.ndarray, np.ndarray]],
    make_arc: Callable[..., np.ndarray],
    monkeypatch: pytest.MonkeyPatch,
    insertion: float,
    bow: float,
    found: bool,
) -> None:
    """The coarse path wanders by millimetres; both ends are seen well."""
    path = make_arc(insertion, 4.0, 1.0)
    points = path[:: len(path) // 8]
    aside = bow * np.sin(np.linspace(0.0, np.pi, len(points)))
    wandering = points + np.outer(aside, [1.0, 0.0, 0.0])
    monkeypatch.setattr(acquisition, "shaft_points", lambda *_: wandering)
    tracker = StereoTracker(calibration, settings)
    measured = tracker.process(*draw_pair(path), insertion)
    assert (measured.tip is not None) is found
    assert found or measured.reason == "the shaft's length is not the insertion"
