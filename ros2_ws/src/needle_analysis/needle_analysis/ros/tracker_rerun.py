"""Recorded images and joints through what stereo_tracker does, without the node or a graph."""

from __future__ import annotations

from typing import Any

import numpy as np

from needle_analysis.rerun.bag_pass import CONVERTER, Output
from needle_bags.reading.bag_images import TOPICS, plain_image
from needle_bags.reading.bag_order import SentMessage
from needle_core.component import Actions, Moment, Publish
from needle_core.convert import from_ros
from needle_tracker.answers.tracker_parameters import StereoTrackerParameters
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.stereo_tracker import TIP_POSE, StereoTipTracker, image_topic


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
        self._tracker = StereoTipTracker(parameters, calibration)
        self.pairs = 0
        self._rows = {row.topic: row for row in self._tracker.inputs}
        self._rows |= {topic: self._rows[image_topic(side)] for topic, side in TOPICS.items()}

    @property
    def topics(self) -> frozenset[str]:
        """Relative names of what it takes."""
        return frozenset(self._rows)

    def take(self, topic: str, sent: SentMessage, message: Any) -> list[Output]:
        """Take a message of a topic, by its relative name; return what it led to."""
        row, log_time = self._rows[topic], sent.log_time
        plain = plain_image(message) if topic in TOPICS else message
        at = Moment(log_time * 1e-9, log_time)
        return self._outputs(row.handler(from_ros(row.message, plain), at), log_time)

    def finish(self, log_time: int) -> list[Output]:
        """Answer what still waits for joints at the bag's end."""
        answers = self._tracker.answers.ready(np.inf)
        return self._outputs(self._tracker.publish(answers, Moment(np.inf, log_time)), log_time)

    def _outputs(self, actions: Actions, log_time: int) -> list[Output]:
        outputs = []
        for action in actions:
            if isinstance(action, Publish):
                self.pairs += action.topic == TIP_POSE
                content = CONVERTER.to_ros(action.message)
                outputs.append(Output(action.topic, log_time, action.message.stamp_ns, content))
        return outputs
