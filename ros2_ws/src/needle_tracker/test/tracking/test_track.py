"""The gates and the states, without any image."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest

from needle_tracker.image.search_grid import Reach
from needle_tracker.optics.window import Layer, Window
from needle_tracker.tracking.gates import GateSettings, refusal, tip_at_entry
from needle_tracker.tracking.refusals import NoTip, TrackState
from needle_tracker.tracking.track import Track
from needle_tracker.tracking.tracker_settings import TrackerSettings
from needle_tracker.tracking.triangulation import SpatialTip


@pytest.fixture
def gates(settings: TrackerSettings) -> GateSettings:
    return settings.gates


def tip(x: float = 0.0, y: float = 0.0, z: float = 0.05) -> SpatialTip:
    return SpatialTip(
        np.array([x, y, z]),
        np.diag([1e-9] * 3),
        np.array([0.0, 0.0, 1.0]),
        np.diag([1e-4, 1e-4, 0.0]),
        1e-5,
        0.01,
    )


@pytest.mark.parametrize("curvature", [2.0, 9.0])
@pytest.mark.parametrize("length", [0.01, 0.14])
@pytest.mark.parametrize("angle", [-0.15, 0.1])
def test_every_reachable_arc_passes(
    gates: GateSettings,
    make_arc: Callable[..., np.ndarray],
    curvature: float,
    length: float,
    angle: float,
) -> None:
    for roll in np.linspace(-3.0, 0.0, 5):
        end = make_arc(length, curvature, roll, angle)[-1]
        if all(window.depth(end) > 0.0 for window in gates.windows):
            assert refusal(tip(*end), length, gates) is None
            assert refusal(tip(*end), None, gates) is None


def test_a_tip_is_behind_both_windows(gates: GateSettings) -> None:
    wall = Window(np.array([0.0, 0.015, 0.0]), np.array([0.0, 1.0, 0.0]), (Layer(5e-3, 1.5),), 1.3)
    gates = dataclasses.replace(gates, windows=(gates.windows[0], wall))
    assert refusal(tip(y=9e-3, z=0.08), None, gates) is None
    assert refusal(tip(y=11e-3, z=0.08), None, gates) == NoTip.OUTSIDE
    assert refusal(tip(y=-11e-3, z=0.08), None, gates) is None
    assert refusal(tip(x=18e-3, z=0.08), None, gates) == NoTip.OUTSIDE


@pytest.mark.parametrize(
    ("changes", "insertion", "reason"),
    [
        ({"disagreement": 3e-3}, None, "along the needle"),
        ({"disagreement_across": 5.0}, None, "across the needle"),
        ({"covariance": np.eye(3) * 1e-4}, None, "uncertain"),
        ({"position": np.array([0.02, 0.0, 0.08])}, None, "outside the phantom"),
        ({"position": np.array([0.0, 0.0, 0.002])}, None, "too close to the entry"),
        ({"position": np.array([0.0, 0.0, 0.3])}, None, "longest insertion"),
        ({"position": np.array([0.0, 0.05, 0.03])}, None, "reachable cone"),
        ({"position": np.array([0.0, 0.0, -0.05])}, None, "reachable cone"),
        ({"direction": np.array([0.0, 0.0, -1.0])}, None, "direction"),
        ({}, 0.04, "farther than the insertion"),
        ({}, 0.06, "short of the insertion"),
    ],
)
def test_each_gate_refuses_by_name(
    gates: GateSettings, changes: dict[str, object], insertion: float | None, reason: str
) -> None:
    changed = dataclasses.replace(tip(), **changes)  # type: ignore[arg-type]
    assert reason in str(refusal(changed, insertion, gates))
    assert refusal(tip(), 0.05, gates) is None


def test_shortest_chord_is_an_arcs() -> None:
    reach = Reach(8.2, 0.1, 1e-3, 0.15)
    radius, length = 1 / 8.2, 0.12
    end = np.array([math.sin(length / radius), 1 - math.cos(length / radius)]) * radius
    assert reach.shortest_chord(length) == pytest.approx(np.linalg.norm(end))


def test_with_the_insertion_known_one_tip_confirms(gates: GateSettings) -> None:
    track = Track(gates)
    states = [track.state]
    assert track.accept(tip(), 0.05) is not None
    states.append(track.state)
    assert states == [TrackState.SEARCHING, TrackState.TRACKING]
    prediction = track.predict(0.051)
    assert prediction is not None
    np.testing.assert_allclose(prediction.motion.position, [0.0, 0.0, 0.051])


def test_without_it_several_must_agree(gates: GateSettings) -> None:
    track = Track(gates)
    moving = [tip(z=0.05 + 1e-3 * i) for i in range(3)]
    assert [track.accept(each, None) is not None for each in moving] == [False, False, True]
    track.reset()
    assert track.accept(tip(), None) is None
    states = [track.state]
    track.miss()
    states.append(track.state)
    assert states == [TrackState.CONFIRMING, TrackState.SEARCHING]
    assert track.anchor is None


def test_what_stands_still_is_not_believed_without_the_insertion(gates: GateSettings) -> None:
    track = Track(gates)
    along = 3.0 * math.sqrt(2e-9)  # 3 standard deviations of two such tips
    for i in range(9):
        assert not track.stands(tip()) or i >= 3
        assert track.accept(tip(z=0.05 + 0.4 * along * (-1) ** i), None) is None
    assert track.stands(tip())
    assert not track.stands(tip(z=0.051))
    assert track.accept(tip(z=0.051), None) is not None
    assert not track.stands(tip(z=0.051))


def test_another_thing_beside_what_stands_still_has_not_moved_there(gates: GateSettings) -> None:
    track = Track(gates)
    for _ in range(3):
        track.accept(tip(), None)
    # Where it is seen first counts for it alone: two more sights, and a way of its own.
    beside = [tip(x=1e-3, z=0.05 + 1e-3 * i) for i in range(3)]
    assert [track.accept(each, None) is not None for each in beside] == [False, False, True]


def test_a_lost_needle_may_stand_where_it_was_believed_and_nowhere_else(
    gates: GateSettings,
) -> None:
    for z, believed in ((0.052, True), (0.0525, False)):
        track = Track(gates)
        for i in range(3):
            track.accept(tip(z=0.05 + 1e-3 * i), None)
        for _ in range(3):
            track.miss()
        assert track.state is TrackState.LOST
        seen = [track.accept(tip(z=z), None) is not None for _ in range(6)]
        assert seen == [False, False, *[believed] * 4]


def test_a_rival_that_stands_still_wins_only_with_the_insertion(gates: GateSettings) -> None:
    for insertion, wins in ((0.05, True), (None, False)):
        track = Track(gates)
        track.accept(tip(), insertion, come=True)
        won = []
        for _ in range(4):
            won.append(track.contest(tip(x=2e-3, z=0.06), insertion, 2))
            track.miss()
        assert any(won) is wins
    assert track.contest(tip(x=2e-3, z=0.061), None, 2)
    assert track.contest(tip(x=-2e-3), None, 1, come=True)


def test_a_rival_is_remembered_beside_what_is_not_believed_yet(gates: GateSettings) -> None:
    track = Track(gates)
    won = []
    for i in range(3):
        assert track.is_open(None)
        assert not track.is_open(0.05)
        won.append(track.contest(tip(x=7e-3, z=0.05 + 1e-3 * i), None, 3))
        track.accept(tip(), None)
    assert won == [False, False, True]
    track.accept(tip(z=0.051), None)
    assert not track.is_open(None)
    assert not track.contest(tip(x=7e-3, z=0.053), None, 2)


def test_without_the_insertion_it_still_goes_its_headings_way(gates: GateSettings) -> None:
    track = Track(gates)
    track.accept(tip(), None, come=True)
    assert track.judge(tip(z=0.054), None) is None
    assert track.judge(tip(x=1.9e-3, z=0.054), None) is None
    assert track.judge(tip(x=2.3e-3, z=0.054), None) == NoTip.TOO_FAR


def test_what_has_come_is_confirmed_by_one_sight_without_the_insertion(gates: GateSettings) -> None:
    track = Track(gates)
    assert track.accept(tip(), None, come=True) is not None
    assert track.state is TrackState.TRACKING


def test_what_the_empty_phantom_lacks_is_believed_for_some_pairs_and_then_has_to_move(
    gates: GateSettings,
) -> None:
    track = Track(gates)
    for _ in range(gates.confirm_pairs):
        assert not track.stands(tip())
        assert track.accept(tip(), None, new=True) is not None
        assert track.is_open(None)
    assert track.stands(tip())
    # Not anew after a gap, nor elsewhere.
    track.miss()
    assert track.accept(tip(), None, new=True) is None
    assert track.accept(tip(x=5e-3), None, new=True) is None
    assert track.accept(tip(x=5e-3, z=0.051), None, new=True) is None
    assert track.accept(tip(x=5e-3, z=0.052), None, new=True) is not None
    assert track.state is TrackState.TRACKING
    track.reset()
    assert track.accept(tip(), None, new=True) is not None


@pytest.mark.parametrize("step", [0.2e-3, 0.5e-3, 1e-3, -1e-3])
def test_an_end_that_stays_while_the_needle_goes_is_none(gates: GateSettings, step: float) -> None:
    track = Track(gates)
    insertions = [0.05 + step * i for i in range(round(6e-3 / abs(step)))]
    stood = []
    for insertion in insertions:
        stood.append(track.stands(tip(), insertion))
        assert not track.stands(tip(z=insertion), insertion)
        track.accept(tip(), insertion)
    assert stood == sorted(stood)
    gone = abs(insertions[stood.index(True)] - insertions[0])
    assert 3e-3 <= gone <= 4e-3 + 1e-9
    # It is remembered when the track is dropped, and not beyond this recording.
    track.drop()
    assert track.stands(tip(), insertions[-1])
    track.reset()
    assert not track.stands(tip(), insertions[-1])


def test_a_needle_whose_end_seems_to_move_by_its_face_does_not_stay(gates: GateSettings) -> None:
    track = Track(gates)
    for i in range(20):
        # In every other pair a glint hides the face, of 2 mm.
        insertion = 0.05 + 1e-3 * i
        seen = tip(z=insertion - 2e-3 * (i % 2))
        assert not track.stands(seen, insertion)
        track.accept(seen, insertion)


@pytest.mark.parametrize(("missed", "confirmed"), [(2, True), (3, False)])
def test_what_is_seen_twice_within_a_few_pairs_is_confirmed(
    gates: GateSettings, missed: int, confirmed: bool
) -> None:
    track = Track(gates)
    assert track.accept(tip(), 0.05, certain=False) is None
    for _ in range(missed):
        track.miss()
    later = track.accept(tip(z=0.0505), 0.0505, certain=False)
    assert (later is not None) is confirmed


@pytest.mark.parametrize(("sights", "certain"), [(0, False), (1, False), (2, True)])
def test_a_track_that_no_two_views_showed_is_not_certain(
    gates: GateSettings, sights: int, certain: bool
) -> None:
    track = Track(gates)
    for i in range(4):
        track.accept(tip(z=0.05 + 1e-3 * i), 0.05 + 1e-3 * i, certain=False, seen=i < sights)
    assert track.is_certain(0.054) is certain
    plain = Track(gates)
    plain.accept(tip(), 0.05)
    assert plain.is_certain(0.05)


def test_a_needle_kept_up_with_stays_uncertain_by_its_way(gates: GateSettings) -> None:
    track = Track(gates)
    track.accept(tip(z=0.05), 0.05)
    for insertion in (0.052, 0.054, 0.056):
        predicted = track.predict(insertion)
        assert predicted is not None
        track.update_from_single_view(predicted, predicted.motion)
    kept = track.predict(0.057)
    assert kept is not None
    assert kept.ahead == pytest.approx(1e-3)
    other = Track(gates)
    other.accept(tip(z=0.05), 0.05)
    left_alone = other.predict(0.057)
    assert left_alone is not None
    assert track.tolerance(kept) == pytest.approx(other.tolerance(left_alone))


def test_a_tip_too_far_from_the_last_is_refused(gates: GateSettings) -> None:
    track = Track(gates)
    track.accept(tip(z=0.05), 0.05)
    assert track.judge(tip(z=0.051), 0.051) is None
    assert track.judge(tip(x=-0.004, z=0.0505), 0.051) == "too far from the last tip"


def test_lost_is_said_and_ends_where_the_needle_can_be(gates: GateSettings) -> None:
    track = Track(gates)
    track.accept(tip(z=0.05), 0.05)
    states = []
    for _ in range(3):
        track.miss()
        states.append(track.state)
    assert states == [TrackState.TRACKING, TrackState.TRACKING, TrackState.LOST]
    assert track.judge(tip(y=-0.006, z=0.0495), 0.0505) == "too far from the last tip"
    assert track.judge(tip(z=0.052), 0.052) is None
    track.accept(tip(z=0.052), 0.052)
    assert track.state is TrackState.TRACKING


def test_long_lost_is_forgotten(gates: GateSettings) -> None:
    track = Track(gates)
    track.accept(tip(), 0.05)
    for _ in range(gates.forget_after):
        track.miss()
    assert track.state is TrackState.SEARCHING
    assert track.judge(tip(y=0.006, z=0.0495), 0.05) is None


def test_entry_starts_afresh(gates: GateSettings) -> None:
    track = Track(gates)
    track.accept(tip(), 0.05)
    track.enter()
    assert track.state is TrackState.ENTRY
    assert track.anchor is None


def test_the_entry_covariance_covers_the_heading(make_arc: Callable[..., np.ndarray]) -> None:
    guess = tip_at_entry(4e-3, 0.5e-3, math.radians(10))
    for roll in (0.0, 1.0, 2.0):
        for pitch in (-0.17, 0.0, 0.17):
            error = make_arc(4e-3, 8.2, roll, pitch)[-1] - guess.position
            assert error @ np.linalg.solve(guess.covariance, error) < 3.0
