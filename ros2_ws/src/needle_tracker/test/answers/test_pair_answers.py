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
