"""Handlers of the tracker's messages, and its answers: for the node and `rerun`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

from geometry_msgs.msg import PointStamped, PoseStamped, PoseWithCovarianceStamped
from sensor_msgs.msg import CameraInfo, Image, JointState

from needle_common.ros.conversions import (
    IMAGES,
    IMAGES_BEST_EFFORT,
    JOINT_STATES,
    LATCHED,
    RELIABLE,
    to_nanoseconds,
)
from needle_common.ros.topic_input import TopicInput
from needle_tracker.answers.health import Health
from needle_tracker.answers.pair_answers import Answer, PairAnswers
from needle_tracker.answers.tracker_parameters import StereoTrackerParameters
from needle_tracker.optics.calibration import SIDES, StereoCalibration
from needle_tracker.ros import conversions

OUTPUTS: Mapping[str, type[Any]] = {
    "needle/tip": PointStamped,
    "needle/tip_pose": PoseWithCovarianceStamped,
}
"""Relative topic to message class of what `output_messages` returns; all are sent RELIABLE."""


class TrackerMessages:
    """The pairing and measuring of images behind messages: one row of `inputs` per topic.

    Parameters
    ----------
    calibration : StereoCalibration
        The stereo rig.
    parameters : StereoTrackerParameters
        The node's.

    Attributes
    ----------
    answers : PairAnswers
        What answers the pairs.
    health : Health
        What the messages say of the rig's.
    inputs, images : mapping of str to TopicInput
        By relative topic, and those of them that come from the cameras; `take` gets the steady time
        at which the message came [s].
    """

    def __init__(self, calibration: StereoCalibration, parameters: StereoTrackerParameters) -> None:
        self._cameras = {"left": calibration.left, "right": calibration.right}
        self.answers = PairAnswers(
            calibration,
            parameters.tracker_settings(calibration),
            parameters.answering_settings(),
        )
        self.health = Health()
        rows = [TopicInput("joint_states", JointState, JOINT_STATES, self._take_joints)]
        if parameters.heading_from_estimate:
            pose = PoseWithCovarianceStamped
            rows += [
                TopicInput("needle/estimate", pose, RELIABLE, self._take_estimate),
                TopicInput("target_plane", PoseStamped, LATCHED, self._take_plane),
            ]
        self.inputs: dict[str, TopicInput[Answer]] = {row.topic: row for row in rows}
        qos = IMAGES if parameters.reliable_images else IMAGES_BEST_EFFORT
        self.images: dict[str, TopicInput[Answer]] = {}
        for side in SIDES:
            take_image, take_info = partial(self._take_image, side), partial(self._take_info, side)
            for topic, kind, take in (
                (image_topic(side), Image, take_image),
                (f"stereo/{side}/camera_info", CameraInfo, take_info),
            ):
                self.images[topic] = TopicInput(topic, kind, qos, take)

    def _take_joints(self, message: JointState, now: float) -> Iterable[Answer]:
        insertion = conversions.insertion_of(message)
        if insertion is None:
            self.health.joints_without_insertion += 1
            return ()
        stamp = to_nanoseconds(message.header.stamp)
        return self.answers.add_insertion(stamp, insertion, now)

    def _take_image(self, side: str, message: Image, now: float) -> Iterable[Answer]:
        self.health.image_came(side, now)
        frame = conversions.to_frame(message, side, self._cameras[side])
        stamp = to_nanoseconds(message.header.stamp)
        return self.answers.add_image(side, stamp, frame, now)

    def _take_info(self, side: str, message: CameraInfo, _: float) -> Iterable[Answer]:
        problem, in_size = conversions.camera_info_problem(message, side, self._cameras[side])
        self.health.camera_info[side] = problem
        self.answers.add_contradiction(side, problem if in_size else "")
        return ()

    def _take_estimate(self, message: PoseWithCovarianceStamped, _: float) -> Iterable[Answer]:
        rotation = conversions.rotation_of(message.pose.pose)
        if rotation is not None:
            sigma = conversions.roll_sigma_of(message.pose.covariance, rotation[:, 2])
            self.answers.add_roll(to_nanoseconds(message.header.stamp), rotation, sigma)
        return ()

    def _take_plane(self, message: PoseStamped, _: float) -> Iterable[Answer]:
        rotation = conversions.rotation_of(message.pose)
        if rotation is not None:
            self.answers.add_plane(rotation)
        return ()


def image_topic(side: str) -> str:
    """Return the relative topic of a camera's images."""
    return f"stereo/{side}/image_raw"


def output_messages(answer: Answer) -> list[tuple[str, Any]]:
    """Return the messages of an answer, each with its relative topic, in the order of sending."""
    stamp, tip = answer.pair.stamp, answer.measured.tip
    measured = [] if tip is None else [("needle/tip", conversions.to_tip(tip, stamp))]
    return [*measured, ("needle/tip_pose", conversions.to_tip_pose(answer.tip, stamp))]
