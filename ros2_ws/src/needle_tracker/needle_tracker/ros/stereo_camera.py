"""ROS shell of the cameras: image pairs from V4L2/UVC cameras, folders or videos, published."""

from __future__ import annotations

import array
import dataclasses
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from ament_index_python.packages import get_package_share_directory
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image

from needle_core.commands.cli import EXIT_DONE
from needle_core.diagnostics import Diagnostic, Level
from needle_core.errors import UserError
from needle_core.process.end_request import EndRequest
from needle_core.ros.base_node import (
    LOOK_PERIOD,
    STEADY_CLOCK,
    DiagnosticsPublisher,
    executor_of,
    run_node,
)
from needle_core.ros.conversions import IMAGES, to_stamp
from needle_core.ros.parameters import NodeParameters
from needle_core.ros.whole_node import WholeNode
from needle_core.settings.parameter_fields import check_fields, fixed_parameter
from needle_tracker.optics.calibration import SIDES, Camera, load_calibration
from needle_tracker.sources.image_files import Image as GreyImage
from needle_tracker.sources.stereo_source import (
    EndOfRecordingError,
    RateMeter,
    SourceSettings,
    StampedPair,
    open_source,
)

HELP = """
stereo_camera: image pairs from two V4L2/UVC cameras, two folders or two video files.

  ros2 run needle_tracker stereo_camera --ros-args -p left:=/dev/video0 -p right:=/dev/video2
  ros2 run needle_tracker stereo_camera --ros-args -p left:=images/left -p right:=images/right

Publishes: stereo/{left,right}/image_raw (mono8), stereo/{left,right}/camera_info, /diagnostics.
Both cameras are grabbed first, then decoded; the stamp is the time of the grab less `latency`.
A camera by its number needs quotes within quotes: -p "left:='0'".
Exit codes: 0 ended by a signal or at the end of the recording; 2 a camera, folder, file or size
that is missing or wrong.
"""
_LAST_IMAGES = 2.0  # [s] for subscribers to take a recording's last images


@dataclasses.dataclass(frozen=True)
class StereoCameraParameters:
    """Parameters of the node; all are fixed at start."""

    left: str = fixed_parameter(
        "", "-", "Left source: device number or /dev/..., folder of images, or video file."
    )
    right: str = fixed_parameter("", "-", "Right source, of the same kind.")
    calibration_file: str = fixed_parameter(
        "", "-", "Calibration file of the stereo rig; empty: the simulated bench's."
    )
    rate: float = fixed_parameter(20.0, "Hz", "Image pairs a second.", 0.1, 1000.0)
    loop: bool = fixed_parameter(
        False, "-", "Begin a recording again at its end, instead of ending with it."
    )
    latency: float = fixed_parameter(
        0.0, "s", "Time from exposure to grab, taken off the stamp (cameras only).", 0.0, 1.0
    )
    triggered: bool = fixed_parameter(
        False, "-", "One trigger line exposes both cameras: both images get the left's stamp."
    )
    wait_for_subscribers: bool = fixed_parameter(
        False, "-", "Begin when somebody subscribes to both images (for recordings)."
    )

    def __post_init__(self) -> None:
        """Check the fields."""
        check_fields(self)


class StereoCameraNode(WholeNode):
    """Publishes what its source gives.

    Parameters
    ----------
    **kwargs
        Passed on to `rclpy.node.Node`.

    Raises
    ------
    UserError
        A bad parameter, calibration file or source.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("stereo_camera", **kwargs)
        self._parameters = NodeParameters(self, StereoCameraParameters).values
        path = self._parameters.calibration_file
        default = Path(get_package_share_directory("needle_tracker"), "config", "calibration.yaml")
        calibration = load_calibration(Path(path) if path else default)
        cameras = {"left": calibration.left, "right": calibration.right}
        self.finished = False
        self._rate = RateMeter()
        self._pairs = 0
        self._skew = 0
        self._infos = {side: _camera_info(cameras[side], side) for side in SIDES}
        self._publishers_of = {
            side: (
                self.create_publisher(Image, f"stereo/{side}/image_raw", IMAGES),
                self.create_publisher(CameraInfo, f"stereo/{side}/camera_info", IMAGES),
            )
            for side in SIDES
        }
        self._diagnostics = DiagnosticsPublisher(self)
        settings = SourceSettings(
            left=self._parameters.left,
            right=self._parameters.right,
            sizes={side: (cameras[side].width, cameras[side].height) for side in SIDES},
            rate=self._parameters.rate,
            loop=self._parameters.loop,
        )
        self._source = open_source(settings, lambda: int(self.get_clock().now().nanoseconds))
        self._begun = time.monotonic()
        self.create_timer(1.0 / self._parameters.rate, self._tick, clock=STEADY_CLOCK)
        self.create_timer(0.5, self._report, clock=STEADY_CLOCK)
        self.get_logger().info(f"publishes images at {self._parameters.rate:g} Hz")
        self._report()

    def close(self) -> None:
        """Give the last images time to arrive, and let go of the source."""
        self._source.close()
        for image, info in self._publishers_of.values():
            for publisher in (image, info):
                if self.finished:
                    publisher.wait_for_all_acked(Duration(seconds=_LAST_IMAGES))

    def _tick(self) -> None:
        if self.finished or not self._awaited():
            return
        try:
            pair = self._source.next()
        except EndOfRecordingError:
            self.finished = True
            self.get_logger().info(
                f"end of the recording: {self._pairs} pairs, {self._source.dropped} unreadable"
            )
            if self._source.missing:
                self.get_logger().warning(f"the recording is not whole: {self._source.missing}")
            return
        if pair is None:
            self.get_logger().warning("a pair could not be read", throttle_duration_sec=5.0)
            return
        self._publish(pair)

    def _publish(self, pair: StampedPair) -> None:
        latency = round(1e9 * self._parameters.latency)
        left_stamp = pair.left_stamp - latency
        right_stamp = left_stamp if self._parameters.triggered else pair.right_stamp - latency
        self._skew = max(self._skew, abs(pair.right_stamp - pair.left_stamp))
        for side, pixels, stamp in (
            ("left", pair.left, left_stamp),
            ("right", pair.right, right_stamp),
        ):
            image, info = self._publishers_of[side]
            message = self._infos[side]
            message.header.stamp = to_stamp(stamp)
            info.publish(message)
            image.publish(_image(pixels, message))
        self._pairs += 1
        self._rate.tick()

    def _awaited(self) -> bool:
        if not self._parameters.wait_for_subscribers or self._pairs:
            return True
        return all(image.get_subscription_count() for image, _ in self._publishers_of.values())

    def _report(self) -> None:
        rate, wanted = self._rate.rate(), self._parameters.rate
        dropped = self._source.dropped
        values = {
            "pairs": str(self._pairs),
            "rate_hz": f"{rate:.1f}",
            "dropped": str(dropped),
            "skew_max_ms": f"{1e-6 * self._skew:.2f}",
        }
        level, message = Level.OK, "images published"
        if not self._awaited():
            level, message = Level.WARN, "waiting for subscribers"
        elif dropped:
            level, message = Level.WARN, "some pairs could not be read"
        elif time.monotonic() - self._begun > 3.0 and rate < 0.8 * wanted:
            level, message = Level.WARN, f"slower than the {wanted:g} Hz asked for"
        self._diagnostics.set("images", Diagnostic(level, message, values))


def _camera_info(camera: Camera, side: str) -> CameraInfo:
    message = CameraInfo(
        height=camera.height,
        width=camera.width,
        distortion_model="plumb_bob",
        d=[float(value) for value in camera.distortion],
        k=camera.camera_matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([camera.camera_matrix, np.zeros((3, 1))]).ravel(),
    )
    message.header.frame_id = f"{side}_camera_optical"
    return message


def _image(pixels: GreyImage, info: CameraInfo) -> Image:
    message = Image(
        header=info.header,
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding="mono8",
        is_bigendian=0,
        step=pixels.shape[1],
    )
    # Anything but an array of bytes is copied element by element.
    data = array.array("B")
    data.frombytes(np.ascontiguousarray(pixels).data)
    message.data = data
    return message


def _spin(node: Node, end: EndRequest) -> int:
    if not isinstance(node, StereoCameraNode):
        raise UserError("not a stereo_camera")
    executor = executor_of(node)
    try:
        while not (node.finished or end.wanted):
            executor.spin_once(timeout_sec=LOOK_PERIOD)
    finally:
        node.close()
        executor.shutdown()
    return EXIT_DONE


def main() -> int:
    """Run the node."""
    return run_node(StereoCameraNode, help_text=HELP, parameters=StereoCameraParameters, spin=_spin)


if __name__ == "__main__":
    sys.exit(main())
