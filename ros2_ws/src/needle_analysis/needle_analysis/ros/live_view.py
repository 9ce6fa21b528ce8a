"""The `live_view` executable: the steered needle as messages that any ROS viewer shows."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMessage
from rclpy.context import Context
from rclpy.parameter import Parameter
from rclpy.subscription import Subscription
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from needle_analysis.live.latest_images import LatestImages
from needle_analysis.live.marked_image import marked_image
from needle_analysis.ros import live_messages
from needle_analysis.ros.needle_hearing import NeedleHearing
from needle_analysis.ros.transform_publishers import transform_publishers
from needle_core.errors import UserError
from needle_core.ros.base_node import STEADY_CLOCK, DiagnosticsPublisher, run_node
from needle_core.ros.conversions import (
    IMAGES_BEST_EFFORT,
    LATCHED,
    RELIABLE,
    to_nanoseconds,
)
from needle_core.ros.parameters import NodeParameters
from needle_core.ros.whole_node import WholeNode
from needle_core.settings.parameter_fields import check_fields, fixed_parameter
from needle_tracker.answers.tracker_messages import frame_of
from needle_tracker.optics.calibration import SIDES, calibration_from
from needle_tracker.optics.refraction import RefractedCamera, stereo_views

HELP = """
live_view: shows the needle to RViz, Foxglove and the like while it is steered. Each of its topics
is sent only while somebody subscribes to it; it moves nothing, and nothing waits for it.

Subscribes  needle/tip_pose, needle/estimate, needle/controller_status, target_plane, joint_states,
            stereo_tracker/calibration; stereo/{left,right}/image_raw (while its view is wanted)
Publishes   ~/tip, ~/path, ~/markers (shaft, tip, estimate, 95 % ellipsoid, plane, target point),
            ~/left/compressed, ~/right/compressed (JPEG, shaft and tip drawn in); /tf, /tf_static
            where tf2_msgs is installed
"""
OUTPUTS: dict[str, type[Any]] = {
    "~/tip": PoseStamped,
    "~/path": PathMessage,
    "~/markers": MarkerArray,
    **{f"~/{side}/compressed": CompressedImage for side in SIDES},
}


@dataclasses.dataclass(frozen=True)
class LiveViewParameters:
    """Parameters of live_view."""

    rate: float = fixed_parameter(
        10.0, "Hz", "How often each message is sent, images included, at most.", 0.5, 30.0
    )

    def __post_init__(self) -> None:
        """Check the fields; raises UserError as `check_fields`."""
        check_fields(self)


class LiveViewNode(WholeNode):
    """Shows a `LiveNeedle` in ROS's own messages.

    Parameters
    ----------
    context : Context, optional
        Where the node lives; the global context by default.
    parameter_overrides : list of Parameter, optional
        Parameters beside those of the command line.
    """

    def __init__(
        self,
        context: Context | None = None,
        parameter_overrides: list[Parameter] | None = None,
    ) -> None:
        super().__init__("live_view", context=context, parameter_overrides=parameter_overrides)
        values = NodeParameters(self, LiveViewParameters).values
        self._diagnostics = DiagnosticsPublisher(self)
        hearing = NeedleHearing(self, self._diagnostics)
        self._needle = hearing.needle
        self._images = {side: LatestImages() for side in SIDES}
        self._cameras: dict[str, RefractedCamera] = {}
        self._hears_images: dict[str, Subscription[Any]] = {}
        self._outputs = {
            topic: self.create_publisher(kind, topic, RELIABLE) for topic, kind in OUTPUTS.items()
        }
        self._tf = transform_publishers(self)
        self.create_subscription(
            String, "stereo_tracker/calibration", self._on_calibration, LATCHED
        )
        self.get_logger().info("shows the needle while somebody looks")
        self.create_timer(1.0 / values.rate, self._show, clock=STEADY_CLOCK)

    def _on_calibration(self, message: String) -> None:
        try:
            calibration = calibration_from(message.data, Path("stereo_tracker/calibration"))
        except UserError as error:
            self._diagnostics.refuse("stereo_tracker/calibration", "no calibration", str(error))
            return
        self._cameras = dict(zip(SIDES, stereo_views(calibration), strict=True))
        if self._tf is not None:
            now = self.get_clock().now().to_msg()
            self._tf.fixed(
                live_messages.camera_transform(side, camera.camera.T_optical_rig, now)
                for side, camera in self._cameras.items()
            )

    def _on_image(self, side: str, message: Image) -> None:
        camera = self._cameras.get(side)
        if camera is None:
            return
        frame = frame_of(message, side, camera.camera)
        if frame.pixels is None:
            self._diagnostics.refuse(f"stereo/{side}/image_raw", "no image of it", frame.problem)
            return
        self._images[side].add(to_nanoseconds(message.header.stamp), frame.pixels)

    # ---- what is shown ------------------------------------------------------------------------

    def _show(self) -> None:
        now = self.get_clock().now().to_msg()
        needle, tip = self._needle, self._needle.tip
        if tip is not None:
            self._send("~/tip", lambda: live_messages.to_tip(tip))
        self._send("~/path", lambda: live_messages.to_path(needle.path, now))
        self._send("~/markers", lambda: live_messages.to_markers(needle, now))
        if self._tf is not None:
            self._tf.moving(lambda: live_messages.to_transforms(needle, now))
        for side in SIDES:
            self._show_image(side)

    def _send(self, topic: str, make: Callable[[], Any]) -> None:
        """Send a message if somebody wants it."""
        if self._outputs[topic].get_subscription_count():
            self._outputs[topic].publish(make())

    def _show_image(self, side: str) -> None:
        topic = f"~/{side}/compressed"
        wanted = self._outputs[topic].get_subscription_count() > 0
        heard = self._hears_images.get(side)
        if wanted and heard is None:
            self._hears_images[side] = self.create_subscription(
                Image, f"stereo/{side}/image_raw", partial(self._on_image, side), IMAGES_BEST_EFFORT
            )
        elif heard is not None and not wanted:
            self.destroy_subscription(self._hears_images.pop(side))
            self._images[side] = LatestImages()
        due = self._images[side].next(self._needle.answered_ns, time.monotonic())
        if due is None:
            return
        stamp_ns, answered, image = due
        shaft, note = np.empty((0, 2)), "no answer of the tracker"
        if answered:
            note = "tip found" if self._needle.is_seen else "no tip found"
        if answered and self._needle.is_seen and self._needle.shaft is not None:
            shaft = self._cameras[side].project(self._needle.shaft)
        data = marked_image(image, shaft, f"{side}: {note}")
        self._outputs[topic].publish(live_messages.to_image(data, side, stamp_ns))


def main() -> int:
    """Run the node."""
    return run_node(LiveViewNode, help_text=HELP, parameters=LiveViewParameters)


if __name__ == "__main__":
    sys.exit(main())
