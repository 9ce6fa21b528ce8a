"""Subscriptions of the console, which fill its picture of the rig."""

from __future__ import annotations

import math
import time
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from sensor_msgs.msg import Image, JointState

from needle_console.view.camera_feed import SIDES, CameraFeed
from needle_console.view.rig_picture import RigPicture
from needle_console.view.snapshot import Array
from needle_core.ros.conversions import IMAGES_BEST_EFFORT, LATCHED, RELIABLE, values_of
from needle_tracker.optics.calibration import rotation_matrix
from needle_tracker.sources.image_encodings import ENCODINGS, bytes_per_pixel, grey_image

_RIG, _PLANE = "rig", "target_plane"
_JOINTS = ("insertion_joint", "rotation_joint")


class RigTopics:
    """Subscriptions; those to images only while somebody looks.

    Parameters
    ----------
    node : Node
        Who hears.
    picture : RigPicture
        Takes what was heard.
    feed : CameraFeed
        Takes the images.
    """

    def __init__(self, node: Node, picture: RigPicture, feed: CameraFeed) -> None:
        self._node = node
        self._picture = picture
        self._feed = feed
        self._images: list[Subscription[Any]] = []
        self._hear(DiagnosticStatus, "device/status", self._on_device, LATCHED)
        self._controller = self._hear(
            DiagnosticStatus, "needle/controller_status", self._on_controller, LATCHED
        )
        self._hear(JointState, "joint_states", self._on_joints, RELIABLE)
        self._hear(PoseWithCovarianceStamped, "needle/tip_pose", self._on_tip, RELIABLE)
        self._hear(PoseWithCovarianceStamped, "needle/estimate", self._on_estimate, RELIABLE)
        self._hear(PoseStamped, _PLANE, self._on_plane, LATCHED)
        self._hear(DiagnosticArray, "/diagnostics", self._on_health, RELIABLE)

    def look(self, now: float) -> None:
        """Begin or end to hear images, as somebody looks or not; see whether a controller is there.

        One that was killed while it steered must not keep the needle in: a press to retract waits
        until steering has ended.
        """
        if not self._controller.get_publisher_count():
            self._picture.lose_controller()
        wanted = self._feed.wanted(now)
        if wanted and not self._images:
            self._images = [
                self._hear(
                    Image,
                    f"stereo/{side}/image_raw",
                    partial(self._on_image, side),
                    IMAGES_BEST_EFFORT,
                )
                for side in SIDES
            ]
        elif not wanted:
            for subscription in self._images:
                self._node.destroy_subscription(subscription)
            self._images = []

    def _hear(self, kind: type, topic: str, take: Any, qos: QoSProfile) -> Subscription[Any]:
        return self._node.create_subscription(kind, topic, take, qos)

    def _on_device(self, message: DiagnosticStatus) -> None:
        self._picture.see_device(values_of(message))

    def _on_controller(self, message: DiagnosticStatus) -> None:
        self._picture.see_controller(values_of(message))

    def _on_joints(self, message: JointState) -> None:
        at = dict(zip(message.name, message.position, strict=False))
        insertion, rotation = (float(at.get(name, math.nan)) for name in _JOINTS)
        self._picture.see_joints(insertion, rotation, time.monotonic())

    def _on_tip(self, message: PoseWithCovarianceStamped) -> None:
        if message.header.frame_id == _RIG:
            self._picture.see_tip(*_position(message), time.monotonic())

    def _on_estimate(self, message: PoseWithCovarianceStamped) -> None:
        if message.header.frame_id == _PLANE:
            self._picture.see_estimate(*_position(message))

    def _on_plane(self, message: PoseStamped) -> None:
        p, q = message.pose.position, message.pose.orientation
        quaternion = np.array([q.x, q.y, q.z, q.w])
        norm = float(np.linalg.norm(quaternion))
        if message.header.frame_id != _RIG or not 0.5 < norm < 2.0:
            return
        pose = np.eye(4)
        pose[:3, :3] = rotation_matrix(quaternion / norm)
        pose[:3, 3] = p.x, p.y, p.z
        self._picture.see_plane(pose)

    def _on_health(self, message: DiagnosticArray) -> None:
        for status in message.status:
            bad = status.level in (DiagnosticStatus.WARN, DiagnosticStatus.ERROR)
            self._picture.see_health(
                status.name, bad=bad, message=status.message, now=time.monotonic()
            )

    def _on_image(self, side: str, message: Image) -> None:
        if message.encoding not in ENCODINGS:
            return
        least = message.width * bytes_per_pixel(message.encoding)
        if not 0 < least <= message.step or len(message.data) != message.step * message.height:
            return
        rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
        image = grey_image(rows, message.width, message.encoding)
        self._feed.put(side, np.ascontiguousarray(image), time.monotonic())


def _position(message: PoseWithCovarianceStamped) -> tuple[Array, Array]:
    """Return a pose's position and its covariance, shapes (3,) and (3, 3), nothing checked."""
    p = message.pose.pose.position
    covariance = np.asarray(message.pose.covariance, dtype=float).reshape(6, 6)
    return np.array([p.x, p.y, p.z]), covariance[:3, :3]
