"""Swapped images are suspected: when the other way round is looked at, and what is enough."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from needle_tracker.answers import pair_answers
from needle_tracker.answers.pair_answers import SwapWatch
from needle_tracker.filter.measurement import Measurement, TrackState
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.tracker_parameters import StereoTrackerParameters

LEFT, RIGHT = np.zeros((2, 4, 4), np.uint8)
MISSED = Measurement(None, TrackState.SEARCHING, "no needle")


class Other:
    """In place of the second tracker: what it finds, and what it was asked."""

    def __init__(self, *_: Any) -> None:
        self.finds, self.looks, self.resets = True, 0, 0

    def reset(self) -> None:
        self.resets += 1

    def process(self, left: Any, right: Any, insertion: Any) -> Measurement:
        assert left is RIGHT
        assert right is LEFT
        self.looks += 1
        tip: Any = object() if self.finds else None
        return Measurement(tip, TrackState.TRACKING, "")


@pytest.fixture
def other(monkeypatch: pytest.MonkeyPatch) -> Other:
    other = Other()
    monkeypatch.setattr(pair_answers, "NeedleTracker", lambda *_: other)
    return other


@pytest.fixture
def watch(calibration: StereoCalibration, settings: StereoTrackerParameters) -> SwapWatch:
    return SwapWatch(calibration, settings)


def misses(watch: SwapWatch, pairs: int) -> None:
    for _ in range(pairs):
        watch.update(LEFT, RIGHT, None, MISSED)


def test_four_agreeing_pairs_after_five_misses_raise_a_suspicion_until_a_tip(
    watch: SwapWatch, other: Other
) -> None:
    entry: Any = Measurement(None, TrackState.ENTRY, "")
    found: Any = dataclasses.replace(entry, tip=object(), state=TrackState.TRACKING)
    looks = []
    seen = ((MISSED, 8), (MISSED, 1), (MISSED, 5), (entry, 1), (found, 1), (MISSED, 5))
    for measured, pairs in seen:
        for _ in range(pairs):
            watch.update(LEFT, RIGHT, None, measured)
        looks.append((other.looks, watch.suspected))
    assert looks == [(3, False), (4, True), (4, True), (4, True), (4, False), (4, False)]


def test_half_of_the_pairs_are_checked_while_swapped_pairs_show_no_needle(
    watch: SwapWatch, other: Other
) -> None:
    other.finds = False
    misses(watch, 5 + 10)
    assert (other.looks, other.resets) == (10, 1)
    misses(watch, 10)
    assert other.looks == 10
    misses(watch, 1)
    assert (other.looks, other.resets) == (11, 2)
    for number in range(9):
        other.finds = number % 4 != 3
        misses(watch, 1)
    assert not watch.suspected
