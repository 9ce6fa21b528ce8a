"""What waits for what between a pair and its answer."""

from __future__ import annotations

import numpy as np
import pytest

from needle_tracker.answers.pair_answers import Frame, PairAnswers, PairingSettings
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.tracking.measurement import Measurement
from needle_tracker.tracking.refusals import TrackState
from needle_tracker.tracking.tracker_settings import TrackerSettings


def test_an_answer_is_out_before_what_it_does_not_need(
    calibration: StereoCalibration, settings: TrackerSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = PairAnswers(calibration, settings, PairingSettings(None, 0.1, 0.0))
    done: list[str] = []

    def process(*_: object) -> Measurement:
        done.append("answered")
        return Measurement(None, TrackState.SEARCHING, "")

    monkeypatch.setattr(answers.tracker, "process", process)
    monkeypatch.setattr(answers.tracker, "catch_up", lambda: done.append("caught up"))
    frame = Frame(np.zeros((768, 1024), np.uint8))
    answers.joints_silent = True
    for stamp in (1, 2):
        list(answers.add_image("left", stamp, frame, 0.0))
        for _ in answers.add_image("right", stamp, frame, 0.0):
            done.append("published")
    assert done == ["answered", "published", "caught up"] * 2


def test_what_was_exposed_before_the_first_joint_state_is_not_answered(
    calibration: StereoCalibration, settings: TrackerSettings
) -> None:
    answers = PairAnswers(calibration, settings, PairingSettings(None, 0.1, 0.0))
    frame = Frame(np.zeros((768, 1024), np.uint8))
    for stamp in (10, 20, 30):
        for side in ("left", "right"):
            assert not list(answers.add_image(side, stamp, frame, 0.0))
    assert [a.pair.stamp for a in answers.add_insertion(20, 0.01, 0.0)] == [20]
    assert [a.pair.stamp for a in answers.add_insertion(40, 0.01, 0.0)] == [30]
