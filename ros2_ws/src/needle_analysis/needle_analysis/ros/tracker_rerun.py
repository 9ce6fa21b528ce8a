"""Recorded images and joints through what stereo_tracker does, without the node or a graph."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from needle_analysis.rerun.bag_pass import Output, stored
from needle_bags.reading.bag_images import SIDES, TOPICS, plain_image
from needle_bags.reading.bag_order import SentMessage
from needle_common.ros.conversions import to_nanoseconds
from needle_tracker.answers.pair_answers import Answer, PairAnswers
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.ros import conversions
from needle_tracker.ros.parameters import StereoTrackerParameters


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
        self._cameras = {"left": calibration.left, "right": calibration.right}
        self._answers = PairAnswers(
            calibration,
            parameters.tracker_settings(calibration.phantom),
            parameters.answering_settings(),
        )
        self.pairs = 0
        self._takers: dict[str, Callable[[Any, float], Iterable[Answer]]] = {
            "joint_states": self._take_joints,
            **{topic: self._taker_of(side) for topic, side in TOPICS.items()},
            **{f"stereo/{side}/camera_info": self._info_taker_of(side) for side in SIDES},
        }
        if parameters.heading_from_estimate:
            self._takers["needle/estimate"] = self._take_estimate
            self._takers["target_plane"] = self._take_plane

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
        return self._publish(self._answers.ready(np.inf), log_time)

    def _taker_of(self, side: str) -> Callable[[Any, float], Iterable[Answer]]:
        def take(message: Any, now: float) -> Iterable[Answer]:
            frame = conversions.to_frame(plain_image(message), side, self._cameras[side])
            return self._answers.add_image(side, to_nanoseconds(message.header.stamp), frame, now)

        return take

    def _info_taker_of(self, side: str) -> Callable[[Any, float], Iterable[Answer]]:
        def take(message: Any, _: float) -> Iterable[Answer]:
            problem = conversions.other_resolution(message, side, self._cameras[side])
            self._answers.add_contradiction(side, problem)
            return ()

        return take

    def _take_joints(self, message: Any, now: float) -> Iterable[Answer]:
        insertion = conversions.insertion_of(message)
        if insertion is None:
            return ()
        return self._answers.add_insertion(to_nanoseconds(message.header.stamp), insertion, now)

    def _take_estimate(self, message: Any, _: float) -> Iterable[Answer]:
        rotation = conversions.rotation_of(message.pose.pose)
        if rotation is not None:
            sigma = conversions.roll_sigma_of(message.pose.covariance, rotation[:, 2])
            self._answers.add_roll(to_nanoseconds(message.header.stamp), rotation, sigma)
        return ()

    def _take_plane(self, message: Any, _: float) -> Iterable[Answer]:
        rotation = conversions.rotation_of(message.pose)
        if rotation is not None:
            self._answers.add_plane(rotation)
        return ()

    def _publish(self, answers: Iterable[Answer], log_time: int) -> list[Output]:
        outputs = []
        for answer in answers:
            stamp, tip = answer.pair.stamp, answer.measured.tip
            self.pairs += 1
            messages = {} if tip is None else {"needle/tip": conversions.to_tip(tip, stamp)}
            messages["needle/tip_pose"] = conversions.to_tip_pose(answer.tip, stamp)
            outputs += [
                Output(topic, log_time, stamp, stored(message))
                for topic, message in messages.items()
            ]
        return outputs
