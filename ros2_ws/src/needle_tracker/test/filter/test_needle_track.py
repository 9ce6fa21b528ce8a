"""Odds of a track after consecutive sightings."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from needle_tracker.detector.end_fit import ImageEnd
from needle_tracker.filter.needle_track import NeedleTrack
from needle_tracker.filter.settings import FILTER
from needle_tracker.stereo.sighting import Sighting
from needle_tracker.stereo.triangulation import SpatialTip
from needle_tracker.tracker_parameters import StereoTrackerParameters

AHEAD = np.array([0.0, 0.0, 1.0])
SIGMA = 0.1e-3
ACCEPTED = math.log(0.9 / 0.1)


def sighting(z: float, evidence: float = 4.0) -> Sighting:
    tip = SpatialTip(np.array([0.0, 0.0, z]), SIGMA**2 * np.eye(3), AHEAD, 1e-4 * np.eye(3))
    end = ImageEnd(np.zeros(2), np.array([1.0, 0.0]), 0.1, 0.5, 0.01, 0.9, 0.9)
    return Sighting(tip, (end, end), evidence, z)


def after(
    settings: StereoTrackerParameters, places: list[float], insertions: list[float | None]
) -> NeedleTrack:
    """Return the track after sightings at these distances from the entry [m]."""
    track = NeedleTrack.begin(sighting(places[0]), insertions[0], settings)
    for place, insertion in zip(places[1:], insertions[1:], strict=True):
        track = track.predicted(insertion, settings)
        if track.fits(sighting(place).tip, settings):
            track = track.updated(sighting(place), settings)
        else:
            track = track.missed()
    return track


def test_an_end_at_the_insertion_is_the_needle_at_once(settings: StereoTrackerParameters) -> None:
    assert after(settings, [0.05], [0.05]).log_odds() > ACCEPTED
    assert after(settings, [0.05], [0.056]).log_odds() < 0.0
    # A stage error of 1 mm does not hide the needle.
    assert after(settings, [0.05], [0.051]).log_odds() > ACCEPTED


def test_an_object_at_rest_while_the_stage_moves_is_rejected(
    settings: StereoTrackerParameters,
) -> None:
    insertions = [0.049 + 5e-4 * n for n in range(8)]
    assert after(settings, [0.05] * 8, list(insertions)).log_odds() < 0.0
    moving = after(settings, [0.001 + i for i in insertions], list(insertions))
    assert moving.log_odds() > ACCEPTED


def test_without_the_insertion_only_a_clear_end_is_the_needle_at_once(
    settings: StereoTrackerParameters,
) -> None:
    accepted = math.log(FILTER.accepted / (1.0 - FILTER.accepted))
    clear, unclear = (
        NeedleTrack.begin(sighting(0.05, evidence), None, settings) for evidence in (4.0, 1.0)
    )
    assert clear.log_odds() > accepted > unclear.log_odds()


def test_without_the_insertion_a_moving_object_is_the_needle(
    settings: StereoTrackerParameters,
) -> None:
    nothing: list[float | None] = [None] * 10
    resting = after(settings, [0.05] * 10, nothing)
    assert resting.log_odds() < ACCEPTED
    moving = after(settings, [0.05 + 1e-3 * n for n in range(4)], nothing[:4])
    assert moving.log_odds() > ACCEPTED


def test_a_miss_reduces_the_rank_and_not_the_odds(settings: StereoTrackerParameters) -> None:
    before = after(settings, [0.05], [0.05])
    missed = before.predicted(0.051, settings).missed()
    assert missed.log_odds() == before.log_odds()
    assert missed.rank() == before.rank() - FILTER.miss_cost
    assert missed.misses == 1


@pytest.mark.parametrize("insertion", [0.05, None])
def test_the_same_picture_again_is_no_further_evidence(
    settings: StereoTrackerParameters, insertion: float | None
) -> None:
    once = after(settings, [0.05], [insertion])
    often = after(settings, [0.05] * 20, [insertion] * 20)
    evidence = often.recent_evidence + often.earlier_evidence
    assert evidence == pytest.approx(once.recent_evidence, abs=0.02)
    assert often.motion_log_odds < 0.1


def test_after_a_gap_the_needle_must_move_again(settings: StereoTrackerParameters) -> None:
    insertions = [0.05 + 1e-3 * n for n in range(20)]
    track = before = after(settings, insertions, list(insertions))
    for n in range(20):
        track = track.predicted(insertions[-1] + 1e-3 * n, settings).missed()
    again = track.updated(sighting(insertions[-1] + 19e-3), settings)
    assert again.motion_log_odds < before.motion_log_odds


@pytest.mark.parametrize(
    "bad", [sighting(0.05, evidence=-7.0), dataclasses.replace(sighting(0.05), length=0.06)]
)
def test_one_bad_sighting_does_not_outweigh_good_ones(
    settings: StereoTrackerParameters, bad: Sighting
) -> None:
    track = NeedleTrack.begin(bad, 0.05, settings)
    assert track.log_odds() < 0.0
    for n in range(1, 6):
        depth = 0.05 + 1e-3 * n
        track = track.predicted(depth, settings).updated(sighting(depth), settings)
    assert track.log_odds() > ACCEPTED


def test_good_sightings_do_not_outweigh_the_recent_bad_ones(
    settings: StereoTrackerParameters,
) -> None:
    depths = [0.05 + 1e-3 * n for n in range(40)]
    track = after(settings, depths, list(depths))
    for n in range(30):
        depth = depths[-1] + 1e-3 * (n + 1)
        bad = sighting(depth, evidence=-7.0)
        track = track.predicted(depth, settings).updated(bad, settings)
    assert track.log_odds() < 0.0
