"""Pairs that wait, that get no answer, and that may be swapped."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest

from needle_tracker.answers import pair_answers
from needle_tracker.answers.pair_answers import Answer, PairAnswers, SwapWatch
from needle_tracker.filter.measurement import Measurement, TrackState
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.sources.image_encodings import Frame
from needle_tracker.tracker_parameters import StereoTrackerParameters

FRAME = Frame(np.zeros((768, 1024), np.uint8))
TIMEOUT = 0.1


class Answering:
    """Pair answers under test; `given` has the insertion of each answered stamp."""

    def __init__(self, answers: PairAnswers) -> None:
        self.answers = answers
        self.given: dict[int, float | str | None] = {}
        self._insertion: float | None = None

    def process(self, left: object, right: object, insertion: float | None) -> Measurement:
        self._insertion = insertion
        return Measurement(None, TrackState.SEARCHING, "")

    def joint(self, stamp: int) -> None:
        self._note(self.answers.add_insertion(stamp, stamp / 1000, 0.0))

    def pair(self, stamp: int) -> None:
        for side in ("left", "right"):
            self._note(self.answers.add_image(side, stamp, FRAME, 0.0))

    def wait(self) -> None:
        self._note(self.answers.ready(TIMEOUT))

    def _note(self, answers: Iterable[Answer]) -> None:
        for answer in answers:
            self.given[answer.pair.stamp] = answer.refused or self._insertion


@pytest.fixture
def answering(calibration: StereoCalibration, monkeypatch: pytest.MonkeyPatch) -> Answering:
    monkeypatch.setattr(
        "needle_tracker.filter.needle_tracker.NeedleTracker.warm_up", lambda _: None
    )
    settings = StereoTrackerParameters(free_running=True, joint_timeout=TIMEOUT)
    answers = PairAnswers(calibration, settings)
    bench = Answering(answers)
    monkeypatch.setattr(bench.answers.tracker, "process", bench.process)
    monkeypatch.setattr(bench.answers.swap, "update", lambda *_: None)
    return bench


def test_an_answer_is_sent_before_the_check_for_swapped_images(
    answering: Answering, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []

    def note(what: str) -> Callable[..., None]:
        return lambda *_: done.append(what)

    monkeypatch.setattr(answering.answers.swap, "update", note("suspected"))
    for stamp in (1, 2):
        list(answering.answers.add_image("left", stamp, FRAME, 0.0))
        list(answering.answers.add_image("right", stamp, FRAME, 0.0))
    for _ in answering.answers.ready(TIMEOUT):
        done.append("published")
    assert done == ["published", "suspected"] * 2


@pytest.mark.parametrize(
    ("arrivals", "answered"),
    [
        # The order of the topics does not matter.
        ("p10 p20 p30 j20 j40", {20: 0.020, 30: 0.030}),
        ("j20 j40 p10 p20 p30", {20: 0.020, 30: 0.030}),
        ("p10 j20 p20 j40 p30", {20: 0.020, 30: 0.030}),
        # A stamp that goes back starts a new history.
        ("j100 j200 j50 j80 p40 p60", {60: 0.060}),
        ("j100 j200 p40 p60 j50 p70 j80", {70: 0.070}),
        # Without joint states, at first or from now on, every pair is answered.
        ("p10 p20 wait p30", {10: None, 20: None, 30: None}),
        ("p10 wait j20 p15 p25 j30", {10: None, 25: 0.025}),
        ("j20 p30 wait p10 p40", {30: None, 10: "time of exposure ran backwards", 40: None}),
    ],
)
def test_a_pair_exposed_before_the_first_joint_state_has_no_answer(
    answering: Answering, arrivals: str, answered: dict[int, float | str | None]
) -> None:
    for arrival in arrivals.split():
        if arrival == "wait":
            answering.wait()
        else:
            take = answering.joint if arrival[0] == "j" else answering.pair
            take(int(arrival[1:]))
    assert answering.given == answered


def test_the_first_joint_state_counts_after_it_was_dropped(answering: Answering) -> None:
    for stamp in range(100, 5000):
        answering.joint(stamp)
    answering.pair(99)
    answering.pair(100)
    answering.pair(4000)
    assert answering.given == {100: None, 4000: 4.0}
    assert answering.answers.unanswered == 1


LEFT, RIGHT = np.zeros((2, 4, 4), np.uint8)
MISSED = Measurement(None, TrackState.SEARCHING, "no needle")


class Other:
    """Stand-in for the second tracker, with a settable result and counters of its calls."""

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


def test_every_second_pair_is_checked_for_swapped_sides_while_no_needle_is_found(
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
