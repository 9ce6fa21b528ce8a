"""Handlers of the controller's messages, and its answers: for the node and `rerun`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import (
    PointStamped,
    PoseStamped,
    PoseWithCovarianceStamped,
    Vector3Stamped,
)
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from needle_common.errors import UserError
from needle_common.ros.conversions import JOINT_STATES, LATCHED, RELIABLE, to_nanoseconds
from needle_common.ros.topic_input import TopicInput
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.continuous import make_steering
from needle_controller.protocol.steering_types import Action, Log, PublishUpdate, SendPath, SendStep
from needle_controller.ros import conversions
from needle_controller.ros.obstacle_messages import OBSTACLES, to_obstacles

OUTPUTS: Mapping[str, type[Any]] = {
    "device/joint_trajectory": JointTrajectory,
    "needle/estimate": PoseWithCovarianceStamped,
    "needle/reduced_state": Vector3Stamped,
    "needle/linearized_state": Vector3Stamped,
    "needle/control_input": Vector3Stamped,
}
"""Relative topic to message class of what `output_messages` returns; all are sent RELIABLE."""


class SteeringMessages:
    """The step protocol behind messages: one row of `inputs` per topic.

    Parameters
    ----------
    settings : SteeringSettings
        The node's.

    Attributes
    ----------
    steering : Steering
        The protocol.
    inputs : mapping of str to TopicInput
        By relative topic; `take` gets the time of sending [ns].
    bad_joints : int
        Joint states refused.
    joints_complaint, plane_complaint, point_complaint, obstacles_complaint : str
        What is wrong with the latest; empty where nothing is.
    """

    def __init__(self, settings: SteeringSettings) -> None:
        self.steering = make_steering(settings)
        self.bad_joints = 0
        self.joints_complaint = ""
        self.plane_complaint = ""
        self.point_complaint = ""
        self.obstacles_complaint = ""
        self.inputs: dict[str, TopicInput[Action]] = {
            row.topic: row
            for row in (
                TopicInput("joint_states", JointState, JOINT_STATES, self._take_joints),
                TopicInput("device/status", DiagnosticStatus, LATCHED, self._take_device),
                TopicInput("device/result", Header, RELIABLE, self._take_result),
                TopicInput("needle/tip", PointStamped, RELIABLE, self._take_tip),
                TopicInput(
                    "needle/tip_pose", PoseWithCovarianceStamped, RELIABLE, self._take_tip_pose
                ),
                TopicInput(conversions.TARGET_PLANE, PoseStamped, LATCHED, self._take_plane),
                TopicInput(conversions.TARGET_POINT, PointStamped, LATCHED, self._take_point),
                TopicInput(OBSTACLES, MarkerArray, LATCHED, self._take_obstacles),
            )
        }

    def _take_joints(self, message: JointState, sent_ns: int) -> Iterable[Action]:
        try:
            sample = conversions.to_joint_sample(message, sent_ns)
        except UserError as error:
            self.bad_joints += 1
            self.joints_complaint = str(error)
            return [Log("warning", str(error), "joints")]
        self.joints_complaint = ""
        return self.steering.on_joints(sample)

    def _take_device(self, message: DiagnosticStatus, _: int) -> Iterable[Action]:
        return self.steering.on_device(conversions.to_device_status(message))

    def _take_result(self, message: Header, sent_ns: int) -> Iterable[Action]:
        return self.steering.on_result(to_nanoseconds(message.stamp), message.frame_id, sent_ns)

    def _take_tip(self, message: PointStamped, _: int) -> Iterable[Action]:
        return self.steering.on_tip(conversions.to_tip(message))

    def _take_tip_pose(self, message: PoseWithCovarianceStamped, _: int) -> Iterable[Action]:
        return self.steering.on_tip_pose(conversions.to_tip_covariance(message))

    def _take_plane(self, message: PoseStamped, _: int) -> Iterable[Action]:
        try:
            plane = conversions.to_plane(message)
            self.steering.settings.check_plane(plane)
        except UserError as error:
            self.plane_complaint = f"{error}; the last plane stays"
            return [Log("warning", self.plane_complaint)]
        self.plane_complaint = ""
        self.steering.control.plane = plane
        self.steering.control.target_point = None
        return [Log("info", f"target_plane at offset {plane.offset:g} m")]

    def _take_point(self, message: PointStamped, _: int) -> Iterable[Action]:
        try:
            point = conversions.to_target_point(message)
            self.steering.settings.check_point(point)
        except UserError as error:
            self.point_complaint = f"{error}; the last target stays"
            return [Log("warning", self.point_complaint, conversions.TARGET_POINT)]
        self.point_complaint = ""
        stamp_ns = to_nanoseconds(message.header.stamp)
        if stamp_ns:
            self.steering.control.see_target_point(point, stamp_ns * 1e-9)
        else:
            # Placed by hand: nobody says when it was there.
            self.steering.control.target_point = point
        x, y, z = point
        text = f"target_point at ({x:g}, {y:g}, {z:g}) m"
        return [Log("info", text, conversions.TARGET_POINT)]

    def _take_obstacles(self, message: MarkerArray, _: int) -> Iterable[Action]:
        try:
            obstacles = to_obstacles(message)
        except UserError as error:
            self.obstacles_complaint = f"{error}; the last obstacles stay"
            return [Log("warning", self.obstacles_complaint, OBSTACLES)]
        self.obstacles_complaint = ""
        self.steering.control.obstacles = obstacles
        return [Log("info", f"{len(obstacles)} obstacles", OBSTACLES)]


def output_messages(action: SendStep | SendPath | PublishUpdate) -> list[tuple[str, Any]]:
    """Return the messages of an action, each with its relative topic, in the order of sending."""
    stamp = action.stamp_ns
    if isinstance(action, SendStep | SendPath):
        return [("device/joint_trajectory", conversions.to_trajectory(action))]
    estimate = action.update.estimate
    return [
        ("needle/estimate", conversions.to_pose(estimate, stamp)),
        ("needle/reduced_state", conversions.to_vector(estimate.reduced, stamp)),
        ("needle/linearized_state", conversions.to_vector(estimate.linearized, stamp)),
        ("needle/control_input", conversions.to_control_input(action.update, stamp)),
    ]
