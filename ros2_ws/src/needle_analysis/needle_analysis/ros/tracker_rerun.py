"""Recorded images and joints through what stereo_tracker does, without the node or a graph."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from needle_analysis.rerun.bag_pass import Output, stored
from needle_bags.reading.bag_images import TOPICS, plain_image
from needle_bags.reading.bag_order import SentMessage
from needle_tracker.answers.pair_answers import Answer
from needle_tracker.answers.tracker_parameters import StereoTrackerParameters
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.ros.tracker_messages import TrackerMessages, image_topic, output_messages


class TrackerStage:
    """Today's tracker on a bag's messages, the node's own conversions around it.

    Parameters
    ----------
    calibration : StereoCalibration
        The stereo rig.
    parameters : StereoTrackerParameters
        The node's.

    Attributes
    ----------
    pairs : int
        Pairs answered so far.
    """

    def __init__(self, calibration: StereoCalibration, parameters: StereoTrackerParameters) -> None:
        self._messages = TrackerMessages(calibration, parameters)
        self.pairs = 0
        rows = {**self._messages.inputs, **self._messages.images}
        self._takers: dict[str, Callable[[Any, float], Iterable[Answer]]] = {
            **{topic: row.take for topic, row in rows.items()},
            **{topic: self._taker_of(side) for topic, side in TOPICS.items()},
        }

    @property
    def topics(self) -> frozenset[str]:
        """Relative names of what it takes."""
        return frozenset(self._takers)

    def take(self, topic: str, sent: SentMessage, message: Any) -> list[Output]:
        """Take a message of a topic, by its relative name; return what it led to."""
        log_time = sent.log_time
        return self._publish(self._takers[topic](message, log_time * 1e-9), log_time)

    def finish(self, log_time: int) -> list[Output]:
        """Answer what still waits for joints at the bag's end."""
        return self._publish(self._messages.answers.ready(np.inf), log_time)

    def _taker_of(self, side: str) -> Callable[[Any, float], Iterable[Answer]]:
        take = self._messages.images[image_topic(side)].take
        return lambda message, now: take(plain_image(message), now)

    def _publish(self, answers: Iterable[Answer], log_time: int) -> list[Output]:
        outputs = []
        for answer in answers:
            self.pairs += 1
            outputs += [
                Output(topic, log_time, answer.pair.stamp, stored(message))
                for topic, message in output_messages(answer)
            ]
        return outputs
