"""Sends what a rig at full rate sends, every message numbered, for the checks of the recorder."""

from __future__ import annotations

import array
import dataclasses
import json
import struct
import sys
import time
from typing import Any, Final

import numpy as np
from geometry_msgs.msg import (
    PointStamped,
    PoseStamped,
    PoseWithCovarianceStamped,
    Vector3Stamped,
)
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, Image, JointState, Joy
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory

from needle_core.process.end_request import EndRequest
from needle_core.ros.base_node import run_node
from needle_core.ros.conversions import HOLD, IMAGES, JOINT_STATES, RELIABLE
from needle_core.ros.node_names import subscribers_of
from needle_core.ros.parameters import NodeParameters
from needle_core.ros.whole_node import WholeNode
from needle_core.settings.parameter_fields import check_fields, fixed_parameter

HELP = """\
recording_load: publishes stereo images and what goes with them, as a rig at full rate does.

The nanoseconds of every header's stamp are the message's number on its topic, from 0. Begins when
a node named recorder listens to every topic; prints, as JSON, what it has sent on which topic.
"""
IMAGE_RATE: Final = 30.0
# (topic, type, rate [Hz], quality of service)
STREAMS: Final = (
    ("stereo/left/image_raw", Image, IMAGE_RATE, IMAGES),
    ("stereo/right/image_raw", Image, IMAGE_RATE, IMAGES),
    ("stereo/left/camera_info", CameraInfo, IMAGE_RATE, IMAGES),
    ("stereo/right/camera_info", CameraInfo, IMAGE_RATE, IMAGES),
    ("needle/tip", PointStamped, IMAGE_RATE, RELIABLE),
    ("needle/tip_pose", PoseWithCovarianceStamped, IMAGE_RATE, RELIABLE),
    ("needle/estimate", PoseWithCovarianceStamped, 5.0, RELIABLE),
    ("needle/reduced_state", Vector3Stamped, 5.0, RELIABLE),
    ("needle/linearized_state", Vector3Stamped, 5.0, RELIABLE),
    ("needle/control_input", Vector3Stamped, 5.0, RELIABLE),
    ("device/joint_trajectory", JointTrajectory, 5.0, RELIABLE),
    ("device/hold", Joy, 20.0, HOLD),
    ("sim/tip_pose", PoseStamped, 50.0, RELIABLE),
    ("joint_states", JointState, 50.0, JOINT_STATES),
)
_STAMP: Final = 4  # behind the four bytes that say how CDR is encoded
_SPIN: Final = 0.002


@dataclasses.dataclass(frozen=True)
class LoadParameters:
    """Parameters of the load."""

    duration: float = fixed_parameter(60.0, "s", "How long to send.", 0.1, 3600.0)
    images: bool = fixed_parameter(True, "-", "Whether to send images too.")

    def __post_init__(self) -> None:
        check_fields(self)


class _PublishedStream:
    """One topic: a message whose stamp is counted up."""

    def __init__(self, node: Node, name: str, kind: type, rate: float, qos: QoSProfile) -> None:
        self.publisher: Publisher = node.create_publisher(kind, name, qos)
        self.period = 1.0 / rate
        self.count = 0
        self._data = bytearray(serialize_message(_example(kind)))

    def send(self) -> None:
        """Publish the next message."""
        struct.pack_into("<iI", self._data, _STAMP, 1, self.count)
        self.publisher.publish(bytes(self._data))
        self.count += 1


class RecordingLoad(WholeNode):
    """Publishes numbered messages on the rig's topics."""

    def __init__(self) -> None:
        super().__init__("recording_load")
        self.values = NodeParameters(self, LoadParameters).values
        self.streams = [
            _PublishedStream(self, *stream)
            for stream in STREAMS
            if self.values.images or stream[1] is not Image
        ]

    def _is_recorded(self, publisher: Publisher) -> bool:
        names = subscribers_of(self, publisher.topic_name)
        return any(name.endswith("/recorder") for name in names)

    def run(self, end: EndRequest) -> None:
        """Send until the time is over and everything has arrived, then print the counts."""
        publishers = [stream.publisher for stream in self.streams]
        while not (end.wanted or all(map(self._is_recorded, publishers))):
            time.sleep(0.05)
        begin = time.monotonic()
        while (elapsed := time.monotonic() - begin) < self.values.duration and not end.wanted:
            for stream in self.streams:
                # Not faster than real time after a pause: a camera does not catch up either.
                if elapsed >= stream.count * stream.period:
                    stream.send()
            time.sleep(_SPIN)
        for publisher in publishers:
            publisher.wait_for_all_acked(Duration(seconds=10))
        counts = {stream.publisher.topic_name: stream.count for stream in self.streams}
        print(json.dumps(counts), flush=True)


def _example(kind: type) -> Any:
    message = kind()
    header = Header(frame_id="rig")
    message.header = header
    if kind is Image:
        message.height, message.width, message.step, message.encoding = 768, 1024, 1024, "mono8"
        noise = np.random.default_rng(1).integers(0, 256, (768, 1024), dtype=np.uint8)
        message.data = array.array("B", noise.tobytes())
    elif kind is CameraInfo:
        message.d = [0.0] * 5
    elif kind is JointState:
        message.name, message.position = ["insertion_joint", "rotation_joint"], [0.0, 0.0]
    elif kind is Joy:
        message.header.frame_id, message.axes, message.buttons = "person", [1.0], [1]
    return message


def _spin(node: Node, end: EndRequest) -> int:
    assert isinstance(node, RecordingLoad)
    node.run(end)
    return 0


def main() -> int:
    """Run the node; returns its exit code."""
    return run_node(RecordingLoad, help_text=HELP, parameters=LoadParameters, spin=_spin)


if __name__ == "__main__":
    sys.exit(main())
