"""The `stereo_tracker` executable: the component `StereoTipTracker` as a ROS node."""

from __future__ import annotations

import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from rclpy.subscription import Subscription

from needle_core.component import Actions, Diagnose, Input, Log, Moment, Publish
from needle_core.convert import Converter, from_ros, ros_type
from needle_core.files.calibration_text import read_calibration
from needle_core.message_types import rclpy_types
from needle_core.ros.base_node import STEADY_CLOCK, DiagnosticsPublisher, run_node
from needle_core.ros.conversions import to_qos
from needle_core.ros.discovery import AnsweringNodes, unpublished, unrecorded
from needle_core.ros.life_signs import LifeSigns
from needle_core.ros.parameters import NodeParameters
from needle_core.ros.whole_node import WholeNode
from needle_tracker.answers.tracker_parameters import StereoTrackerParameters
from needle_tracker.optics.calibration import SIDES, calibration_from
from needle_tracker.stereo_tracker import (
    ANNOTATED,
    TARGET_PLANE,
    TIP,
    TIP_POSE,
    StereoTipTracker,
    image_topic,
)

HELP = """
stereo_tracker: where the needle's tip is, from stereo images through the phantom's surface.

Subscribes: stereo/{left,right}/image_raw, stereo/{left,right}/camera_info, joint_states.
Publishes: needle/tip (only where a tip was found), needle/tip_pose (one for every image pair; an
infinite covariance says that no tip was found), /diagnostics, ~/calibration (the text of the file
in use, latched), ~/annotated_image (while someone subscribes).
"""


class StereoTrackerNode(WholeNode):
    """The ROS shell of `StereoTipTracker`: hears, publishes, reports.

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
        self._component = StereoTipTracker(parameters, calibration_from(text, path), text)
        self._types = rclpy_types()
        self._converter = Converter(self._types)
        self._outputs = {
            row.topic: self.create_publisher(
                self._types.make(ros_type(row.message)),
                row.topic.replace(f"{self._component.name}/", "~/"),
                to_qos(row.delivery),
            )
            for row in self._component.outputs
        }
        self._diagnostics = DiagnosticsPublisher(self)
        self._image_rows = [
            row for row in self._component.inputs if row.topic.startswith("stereo/")
        ]
        sources = {
            row.topic: self._hear(row)
            for row in self._component.inputs
            if row not in self._image_rows
        }
        self._sources = [heard for topic, heard in sources.items() if topic != TARGET_PLANE]
        self._partners = AnsweringNodes(self)
        self._hears_images = False
        if not parameters.wait_for_recorder:
            self._hear_images()
        for timer in self._component.timers:
            self.create_timer(timer.period, self._check, clock=STEADY_CLOCK)
        self._life = LifeSigns(
            self,
            self._diagnostics,
            "finds the needle's tip in stereo images",
            self._waits_for,
            alone_on=(TIP, TIP_POSE),
        )
        self._do(self._component.check(self._moment()))

    def _moment(self) -> Moment:
        return Moment(time.monotonic(), self.get_clock().now().nanoseconds)

    def _waits_for(self) -> list[str]:
        images = map(self.resolve_topic_name, map(image_topic, SIDES))
        return [
            *unpublished(self, self._sources),
            *(f"publisher of {topic}" for topic in images if not self.count_publishers(topic)),
        ]

    def _hear(self, row: Input) -> Subscription[Any]:
        """Subscribe to a topic."""
        kind = self._types.make(ros_type(row.message))
        hear = partial(self._on_message, row)
        return self.create_subscription(kind, row.topic, hear, to_qos(row.delivery))

    def _hear_images(self) -> None:
        """Subscribe to the images."""
        self._hears_images = True
        for row in self._image_rows:
            self._hear(row)

    def _on_message(self, row: Input, message: Any) -> None:
        self._do(row.handler(from_ros(row.message, message), self._moment()))

    def _check(self) -> None:
        # An answer that is sent before the recorder listens is not in the bag; a joint state that
        # is sent before its publisher knows this node comes never.
        if not (
            self._hears_images
            or unrecorded(self, (self._outputs[TIP], self._outputs[TIP_POSE]))
            or self._partners.unaware_sources(self._sources)
        ):
            self._hear_images()
        annotated = self._outputs[ANNOTATED]
        self._component.is_annotation_wanted = annotated.get_subscription_count() > 0
        self._do(self._component.check(self._moment()))

    def _do(self, actions: Actions) -> None:
        for action in actions:
            match action:
                case Publish(topic, message):
                    self._outputs[topic].publish(self._converter.to_ros(message))
                case Diagnose(part, diagnostic):
                    self._diagnostics.set(part, diagnostic)
                case Log(_, text):
                    self.get_logger().warning(text)


def main() -> int:
    """Run the node."""
    return run_node(StereoTrackerNode, help_text=HELP, parameters=StereoTrackerParameters)


if __name__ == "__main__":
    sys.exit(main())
