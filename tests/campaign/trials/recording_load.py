"""Publishes stereo images and all other topics of a rig at full rate.

`python -m campaign.trials.recording_load SECONDS [small]`: the nanoseconds of every header's stamp
are the message's number on its topic, from 0. Begins when a node named recorder listens to every
topic; prints, as JSON, the number of messages sent on each topic. `small` leaves the images out.
"""

from __future__ import annotations

import array
import json
import struct
import sys
import time
from typing import Any, Final

import numpy as np
import rclpy
from geometry_msgs.msg import PointStamped, PoseStamped, PoseWithCovarianceStamped, Vector3Stamped
from rclpy.duration import Duration
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, Image, JointState, Joy
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory

from needle_core.process.discovery import restrict_discovery
from needle_core.ros.base_node import (
    HOLD,
    IMAGES,
    JOINT_STATES,
    RELIABLE,
    WholeNode,
    subscribers_of,
)

# (topic, type, rate [Hz], quality of service)
STREAMS: Final = (
    ("stereo/left/image_raw", Image, 30.0, IMAGES),
    ("stereo/right/image_raw", Image, 30.0, IMAGES),
    ("stereo/left/camera_info", CameraInfo, 30.0, IMAGES),
    ("stereo/right/camera_info", CameraInfo, 30.0, IMAGES),
    ("needle/tip", PointStamped, 30.0, RELIABLE),
    ("needle/tip_pose", PoseWithCovarianceStamped, 30.0, RELIABLE),
    ("needle/estimate", PoseWithCovarianceStamped, 5.0, RELIABLE),
    ("needle/reduced_state", Vector3Stamped, 5.0, RELIABLE),
    ("needle/control_input", Vector3Stamped, 5.0, RELIABLE),
    ("device/joint_trajectory", JointTrajectory, 5.0, RELIABLE),
    ("device/hold", Joy, 20.0, HOLD),
    ("sim/tip_pose", PoseStamped, 50.0, RELIABLE),
    ("joint_states", JointState, 50.0, JOINT_STATES),
)
_STAMP: Final = 4  # after the four bytes of the CDR encapsulation header


def main(duration: float, *, images: bool) -> None:
    """Publish for a duration [s]; print the number of messages by topic."""
    restrict_discovery()
    rclpy.init(args=[])
    node = WholeNode("recording_load")
    chosen = [stream for stream in STREAMS if images or stream[1] is not Image]
    publishers = [node.create_publisher(kind, name, qos) for name, kind, _, qos in chosen]
    data = [bytearray(serialize_message(_example(kind))) for _, kind, _, _ in chosen]
    counts = [0] * len(chosen)
    while not all(
        any(name.endswith("/recorder") for name in subscribers_of(node, publisher.topic_name))
        for publisher in publishers
    ):
        time.sleep(0.05)
    # Wait for the discovery of other subscribers.
    time.sleep(1.0)
    begin = time.monotonic()
    while (elapsed := time.monotonic() - begin) < duration:
        for number, (_, _, rate, _) in enumerate(chosen):
            # Do not catch up after a pause, as a camera does not.
            if elapsed * rate >= counts[number]:
                struct.pack_into("<iI", data[number], _STAMP, 1, counts[number])
                publishers[number].publish(bytes(data[number]))
                counts[number] += 1
        time.sleep(0.002)
    for publisher in publishers:
        publisher.wait_for_all_acked(Duration(seconds=10))
    names = [publisher.topic_name for publisher in publishers]
    print(json.dumps(dict(zip(names, counts, strict=True))), flush=True)
    rclpy.try_shutdown()


def _example(kind: type) -> Any:
    message = kind()
    message.header = Header(frame_id="rig")
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


if __name__ == "__main__":
    main(float(sys.argv[1]), images="small" not in sys.argv[2:])
