"""ROS shell of the stereo tracker: images and joint states in, one answer for every pair out."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from geometry_msgs.msg import PointStamped, PoseStamped, PoseWithCovarianceStamped
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import String

from needle_common.diagnostics import Diagnostic, Level
from needle_common.ros.base_node import STEADY_CLOCK, DiagnosticsPublisher, run_node
from needle_common.ros.conversions import (
    IMAGES,
    IMAGES_BEST_EFFORT,
    JOINT_STATES,
    LATCHED,
    RELIABLE,
    to_nanoseconds,
)
from needle_common.ros.discovery import AnsweringNodes, unpublished, unrecorded
from needle_common.ros.life_signs import LifeSigns
from needle_common.ros.parameters import NodeParameters
from needle_common.ros.whole_node import WholeNode
from needle_tracker.answers.annotation import annotate
from needle_tracker.answers.health import Health
from needle_tracker.answers.pair_answers import Answer, PairAnswers
from needle_tracker.optics.calibration import SIDES, calibration_from, read_calibration
from needle_tracker.ros.conversions import (
    camera_info_problem,
    insertion_of,
    other_resolution,
    roll_sigma_of,
    rotation_of,
    to_frame,
    to_image,
    to_tip,
    to_tip_pose,
)
from needle_tracker.ros.parameters import StereoTrackerParameters
from needle_tracker.tracking.track import TrackState

HELP = """
stereo_tracker: where the needle's tip is, from stereo images through the phantom's surface.

Subscribes: stereo/{left,right}/image_raw, stereo/{left,right}/camera_info, joint_states.
Publishes: needle/tip (only where a tip was found), needle/tip_pose (one for every image pair; an
infinite covariance says that no tip was found), /diagnostics, ~/calibration (the text of the file
in use, latched), ~/annotated_image (while someone subscribes).
"""
_CHECK_PERIOD = 0.05  # [s]


class StereoTrackerNode(WholeNode):
    """The ROS shell of `pair_answers.PairAnswers`: converts, calls, publishes, reports.

    Parameters
    ----------
    **kwargs
        Passed on to `rclpy.node.Node`.

    Raises
    ------
    UserError
        A bad parameter or calibration file.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("stereo_tracker", **kwargs)
        parameters = NodeParameters(self, StereoTrackerParameters).values
        default = Path(get_package_share_directory("needle_tracker"), "config", "calibration.yaml")
        path = Path(parameters.calibration_file or default)
        text = read_calibration(path)
        calibration = calibration_from(text, path)
        self._cameras = {"left": calibration.left, "right": calibration.right}
        self._answers = PairAnswers(
            calibration,
            parameters.tracker_settings(calibration.phantom),
            parameters.answering_settings(),
        )
        rate = parameters.annotated_rate
        self._annotated_period = 1.0 / rate if rate > 0.0 else math.inf
        self._annotated_at = -math.inf
        self._health = Health()
        # What every start begins with is not worth a warning in the log.
        self._told = {"track": TrackState.SEARCHING.value, "images": "no images yet"}

        self._tip = self.create_publisher(PointStamped, "needle/tip", RELIABLE)
        self._tip_pose = self.create_publisher(
            PoseWithCovarianceStamped, "needle/tip_pose", RELIABLE
        )
        self._annotated = self.create_publisher(Image, "~/annotated_image", IMAGES)
        # So that whatever records the graph has what the tips were measured with.
        self._calibration = self.create_publisher(String, "~/calibration", LATCHED)
        self._calibration.publish(String(data=text))
        self._diagnostics = DiagnosticsPublisher(self)
        self._sources: list[Subscription[Any]] = [
            self.create_subscription(JointState, "joint_states", self._on_joints, JOINT_STATES)
        ]
        if parameters.heading_from_estimate:
            estimates = self.create_subscription(
                PoseWithCovarianceStamped, "needle/estimate", self._on_estimate, RELIABLE
            )
            self._sources.append(estimates)
            self.create_subscription(PoseStamped, "target_plane", self._on_target, LATCHED)
        self._partners = AnsweringNodes(self)
        self._image_quality = IMAGES if parameters.reliable_images else IMAGES_BEST_EFFORT
        self._hears_images = False
        if not parameters.wait_for_recorder:
            self._hear_images()
        self.create_timer(_CHECK_PERIOD, self._check, clock=STEADY_CLOCK)
        self._life = LifeSigns(
            self,
            self._diagnostics,
            "finds the needle's tip in stereo images",
            self._waits_for,
            alone_on=("needle/tip", "needle/tip_pose"),
        )
        self._report()

    def _waits_for(self) -> list[str]:
        missing = unpublished(self, self._sources)
        missing += [
            f"publisher of {topic}"
            for side in SIDES
            if not self.count_publishers(topic := self.resolve_topic_name(_image_of(side)))
        ]
        return missing

    def _hear_images(self) -> None:
        """Subscribe to the images."""
        self._hears_images = True
        for side in SIDES:
            self.create_subscription(
                Image,
                _image_of(side),
                lambda message, side=side: self._on_image(side, message),
                self._image_quality,
            )
            self.create_subscription(
                CameraInfo,
                f"stereo/{side}/camera_info",
                lambda message, side=side: self._on_camera_info(side, message),
                self._image_quality,
            )

    def _on_camera_info(self, side: str, message: CameraInfo) -> None:
        camera = self._cameras[side]
        self._health.camera_info[side] = camera_info_problem(message, side, camera)
        self._answers.add_contradiction(side, other_resolution(message, side, camera))

    def _on_joints(self, message: JointState) -> None:
        insertion = insertion_of(message)
        if insertion is None:
            self._health.joints_without_insertion += 1
            return
        stamp = to_nanoseconds(message.header.stamp)
        self._publish(self._answers.add_insertion(stamp, insertion, time.monotonic()))

    def _on_image(self, side: str, message: Image) -> None:
        now = time.monotonic()
        self._health.image_came(side, now)
        frame = to_frame(message, side, self._cameras[side])
        stamp = to_nanoseconds(message.header.stamp)
        self._publish(self._answers.add_image(side, stamp, frame, now))

    def _check(self) -> None:
        # An answer that is sent before the recorder listens is not in the bag; a joint state that
        # is sent before its publisher knows this node comes never.
        if not (
            self._hears_images
            or unrecorded(self, (self._tip, self._tip_pose))
            or self._partners.unaware_sources(self._sources)
        ):
            self._hear_images()
        self._publish(self._answers.ready(time.monotonic()))
        self._report()

    def _publish(self, answers: Iterable[Answer]) -> None:
        for answer in answers:
            stamp, measured = answer.pair.stamp, answer.measured
            if measured.tip is not None:
                self._tip.publish(to_tip(measured.tip, stamp))
            self._tip_pose.publish(to_tip_pose(answer.tip, stamp))
            self._annotate(answer)
            now = time.monotonic()
            if answer.refused:
                self._health.pair_refused(answer.refused, now)
            self._health.pair_done(answer.arrival, now, measured)
            self._report()

    def _on_estimate(self, message: PoseWithCovarianceStamped) -> None:
        rotation = rotation_of(message.pose.pose)
        if rotation is None:
            return
        sigma = roll_sigma_of(message.pose.covariance, rotation[:, 2])
        self._answers.add_roll(to_nanoseconds(message.header.stamp), rotation, sigma)

    def _on_target(self, message: PoseStamped) -> None:
        rotation = rotation_of(message.pose)
        if rotation is not None:
            self._answers.add_plane(rotation)

    def _annotate(self, answer: Answer) -> None:
        now = time.monotonic()
        left, right = answer.pair.left.pixels, answer.pair.right.pixels
        due = now - self._annotated_at >= self._annotated_period
        if not due or left is None or right is None:
            return
        if self._annotated.get_subscription_count() == 0:
            return
        self._annotated_at = now
        picture = annotate(left, right, answer.measured)
        self._annotated.publish(to_image(picture, answer.pair.stamp))

    def _report(self) -> None:
        now = time.monotonic()
        answers, health = self._answers, self._health
        health.note_pairing(now, answers.matcher)
        health.swapped = answers.swap.suspected
        self._tell("track", health.track())
        self._tell("images", health.images(now, answers.matcher))
        self._tell("joints", health.joints(answers.insertions, answers.joints_silent))

    def _tell(self, part: str, diagnostic: Diagnostic) -> None:
        """Publish a part's health; log it where it turns bad, not each time it still is."""
        self._diagnostics.set(part, diagnostic)
        kind = diagnostic.message.partition(":")[0]
        if kind != self._told.get(part) and diagnostic.level >= Level.WARN:
            self.get_logger().warning(f"{part}: {diagnostic.message}")
        self._told[part] = kind


def _image_of(side: str) -> str:
    return f"stereo/{side}/image_raw"


def main() -> int:
    """Run the node."""
    return run_node(StereoTrackerNode, help_text=HELP, parameters=StereoTrackerParameters)


if __name__ == "__main__":
    sys.exit(main())
