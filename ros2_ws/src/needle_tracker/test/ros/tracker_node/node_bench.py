"""The node under test, and around it cameras and joints."""

from __future__ import annotations

import array
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, Image, JointState

from needle_core.ros.component_node import ComponentNode
from needle_core.ros.conversions import (
    IMAGES,
    JOINT_STATES,
    RELIABLE,
    to_stamp,
)
from needle_tracker.answers.tracker_parameters import StereoTrackerParameters
from needle_tracker.stereo_tracker import StereoTipTracker, make_tracker

LIMIT = 20.0
INSERTION = 0.05

Drawer = Callable[..., tuple[np.ndarray, np.ndarray]]
Images = tuple[np.ndarray, np.ndarray]


class Bench:
    """The node under test and everything around it, on one executor."""

    def __init__(self, context: Context, **parameters: Any) -> None:
        self.node = ComponentNode(
            "stereo_tracker",
            StereoTrackerParameters,
            make_tracker,
            context=context,
            parameter_overrides=[Parameter(name, value=v) for name, v in parameters.items()],
        )
        assert isinstance(self.node.component, StereoTipTracker)
        self.tracker = self.node.component
        self.outside = Node("outside", context=context)
        self._executor = SingleThreadedExecutor(context=context)
        for node in (self.node, self.outside):
            self._executor.add_node(node)
        self.tips: list[PointStamped] = []
        self.poses: list[PoseWithCovarianceStamped] = []
        self.health: defaultdict[str, tuple[int, str, dict[str, str]]] = defaultdict(
            lambda: (-1, "", {})
        )
        outside = self.outside
        outside.create_subscription(PointStamped, "needle/tip", self.tips.append, RELIABLE)
        outside.create_subscription(
            PoseWithCovarianceStamped, "needle/tip_pose", self.poses.append, RELIABLE
        )
        outside.create_subscription(DiagnosticArray, "/diagnostics", self._on_health, RELIABLE)
        self._joints = outside.create_publisher(JointState, "joint_states", JOINT_STATES)
        self._images = {
            side: outside.create_publisher(Image, f"stereo/{side}/image_raw", IMAGES)
            for side in ("left", "right")
        }
        self._infos = outside.create_publisher(CameraInfo, "stereo/left/camera_info", IMAGES)
        publishers = [self._joints, self._infos, *self._images.values()]
        self.until(lambda: all(p.get_subscription_count() for p in publishers))
        answers = [self.node.outputs[topic] for topic in ("needle/tip", "needle/tip_pose")]
        self.until(lambda: all(p.get_subscription_count() for p in answers))

    def close(self) -> None:
        for node in (self.node, self.outside):
            self._executor.remove_node(node)
            node.destroy_node()
        self._executor.shutdown()

    def _on_health(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            part = status.name.split(": ")[1]
            self.health[part] = (status.level[0], status.message, values)

    def until(self, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < end, "waited in vain"
            self._executor.spin_once(timeout_sec=0.05)

    def joints(self, stamp: int, insertion: float = INSERTION) -> None:
        message = JointState(name=["rotation_joint", "insertion_joint"], position=[0.0, insertion])
        message.header.stamp = to_stamp(stamp)
        self._joints.publish(message)

    def image(
        self,
        side: str,
        stamp: int,
        pixels: np.ndarray,
        encoding: str = "mono8",
        cut_off: int = 0,
    ) -> None:
        height, width = pixels.shape
        message = Image(height=height, width=width, step=width, encoding=encoding)
        message.header.stamp = to_stamp(stamp)
        data = array.array("B")
        data.frombytes(pixels.tobytes()[: pixels.size - cut_off])
        message.data = data
        self._images[side].publish(message)

    def camera_info(self, width: int, height: int, **fields: Any) -> None:
        self._infos.publish(CameraInfo(width=width, height=height, **fields))

    def pair(self, stamp: int, images: Images) -> PoseWithCovarianceStamped:
        """Publish a pair with its joint state, and return the answer."""
        self.joints(stamp)
        self.image("left", stamp, images[0])
        self.image("right", stamp, images[1])
        return self.answer()

    def answer(self) -> PoseWithCovarianceStamped:
        wanted = len(self.poses) + 1
        self.until(lambda: len(self.poses) >= wanted)
        return self.poses[-1]


def found(pose: PoseWithCovarianceStamped) -> bool:
    diagonal = np.reshape(pose.pose.covariance, (6, 6)).diagonal()
    assert np.all(np.isfinite(diagonal)) or np.all(np.isinf(diagonal))
    return bool(np.all(np.isfinite(diagonal)))
