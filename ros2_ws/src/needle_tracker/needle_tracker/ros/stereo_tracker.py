"""ROS shell of the stereo tracker: images and joint states in, one answer for every pair out."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from rclpy.subscription import Subscription
from sensor_msgs.msg import Image
from std_msgs.msg import String

from needle_common.diagnostics import Diagnostic, Level
from needle_common.files.calibration_text import read_calibration
from needle_common.ros.base_node import STEADY_CLOCK, DiagnosticsPublisher, run_node
from needle_common.ros.conversions import IMAGES, LATCHED, RELIABLE
from needle_common.ros.discovery import AnsweringNodes, unpublished, unrecorded
from needle_common.ros.life_signs import LifeSigns
from needle_common.ros.parameters import NodeParameters
from needle_common.ros.topic_input import TopicInput
from needle_common.ros.whole_node import WholeNode
from needle_tracker.answers.annotation import annotate
from needle_tracker.answers.pair_answers import Answer
from needle_tracker.answers.tracker_parameters import StereoTrackerParameters
from needle_tracker.optics.calibration import SIDES, calibration_from
from needle_tracker.ros.conversions import to_image
from needle_tracker.ros.tracker_messages import (
    OUTPUTS,
    TrackerMessages,
    image_topic,
    output_messages,
)
from needle_tracker.tracking.refusals import TrackState

HELP = """
stereo_tracker: where the needle's tip is, from stereo images through the phantom's surface.

Subscribes: stereo/{left,right}/image_raw, stereo/{left,right}/camera_info, joint_states.
Publishes: needle/tip (only where a tip was found), needle/tip_pose (one for every image pair; an
infinite covariance says that no tip was found), /diagnostics, ~/calibration (the text of the file
in use, latched), ~/annotated_image (while someone subscribes).
"""
_CHECK_PERIOD = 0.05  # [s]


class StereoTrackerNode(WholeNode):
    """The ROS shell of `TrackerMessages`: hears, publishes, reports.

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
        self._messages = TrackerMessages(calibration, parameters)
        self._answers, self._health = self._messages.answers, self._messages.health
        rate = parameters.annotated_rate
        self._annotated_period = 1.0 / rate if rate > 0.0 else math.inf
        self._annotated_at = -math.inf
        # What every start begins with is not worth a warning in the log.
        self._told = {"track": TrackState.SEARCHING.value, "images": "no images yet"}

        self._outputs = {
            topic: self.create_publisher(kind, topic, RELIABLE) for topic, kind in OUTPUTS.items()
        }
        self._annotated = self.create_publisher(Image, "~/annotated_image", IMAGES)
        # So that whatever records the graph has what the tips were measured with.
        self._calibration = self.create_publisher(String, "~/calibration", LATCHED)
        self._calibration.publish(String(data=text))
        self._diagnostics = DiagnosticsPublisher(self)
        sources = {row.topic: self._hear(row) for row in self._messages.inputs.values()}
        self._sources = [heard for topic, heard in sources.items() if topic != "target_plane"]
        self._partners = AnsweringNodes(self)
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
        images = map(self.resolve_topic_name, map(image_topic, SIDES))
        return [
            *unpublished(self, self._sources),
            *(f"publisher of {topic}" for topic in images if not self.count_publishers(topic)),
        ]

    def _hear(self, row: TopicInput[Answer]) -> Subscription[Any]:
        """Subscribe to a topic."""
        return self.create_subscription(
            row.kind,
            row.topic,
            lambda message: self._publish(row.take(message, time.monotonic())),
            row.qos,
        )

    def _hear_images(self) -> None:
        """Subscribe to the images."""
        self._hears_images = True
        for row in self._messages.images.values():
            self._hear(row)

    def _check(self) -> None:
        # An answer that is sent before the recorder listens is not in the bag; a joint state that
        # is sent before its publisher knows this node comes never.
        if not (
            self._hears_images
            or unrecorded(self, self._outputs.values())
            or self._partners.unaware_sources(self._sources)
        ):
            self._hear_images()
        self._publish(self._answers.ready(time.monotonic()))
        self._report()

    def _publish(self, answers: Iterable[Answer]) -> None:
        for answer in answers:
            for topic, message in output_messages(answer):
                self._outputs[topic].publish(message)
            self._annotate(answer)
            now = time.monotonic()
            if answer.refused:
                self._health.pair_refused(answer.refused, now)
            self._health.pair_done(answer.arrival, now, answer.measured)
            self._report()

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


def main() -> int:
    """Run the node."""
    return run_node(StereoTrackerNode, help_text=HELP, parameters=StereoTrackerParameters)


if __name__ == "__main__":
    sys.exit(main())
