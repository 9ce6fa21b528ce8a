"""What waits for what between a pair and its answer, and which pairs have none."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import pytest

from needle_tracker.answers.pair_answers import Answer, Frame, PairAnswers
from needle_tracker.filter.measurement import Measurement, TrackState
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.tracker_parameters import StereoTrackerParameters

FRAME = Frame(np.zeros((768, 1024), np.uint8))
TIMEOUT = 0.1


class Answering:
    """Pairs and joint states in; the stamps of answered pairs with the insertions given to them."""

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


def test_a_pair_waits_for_the_joint_state_that_follows_it(answering: Answering) -> None:
    answering.joint(10)
    answering.pair(15)
    assert not answering.given
    answering.joint(20)
    assert answering.given == {15: 0.015}


@pytest.mark.parametrize(
    ("arrivals", "answered"),
    [
        # Which topic was heard first is no matter.
        ("p10 p20 p30 j20 j40", {20: 0.020, 30: 0.030}),
        ("j20 j40 p10 p20 p30", {20: 0.020, 30: 0.030}),
        ("p10 j20 p20 j40 p30", {20: 0.020, 30: 0.030}),
        # A stamp that runs backwards begins a new history.
        ("j100 j200 j50 j80 p40 p60", {60: 0.060}),
        ("j100 j200 p40 p60 j50 p70 j80", {70: 0.070}),
        # Without joint states, at first or for good, nothing is left out.
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


def test_the_first_joint_state_is_known_when_it_is_no_longer_kept(answering: Answering) -> None:
    for stamp in range(100, 5000):
        answering.joint(stamp)
    answering.pair(99)
    answering.pair(100)
    answering.pair(4000)
    assert answering.given == {100: None, 4000: 4.0}
    assert answering.answers.unanswered == 1
