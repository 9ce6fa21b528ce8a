"""Hears what the graph says of the needle, and believes of it what a needle can be."""

from __future__ import annotations

from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from sensor_msgs.msg import JointState

from needle_analysis.live.live_needle import Belief, LiveNeedle, SeenTip
from needle_controller.model.target_plane import plane_from_pose
from needle_core import messages
from needle_core.convert import from_ros
from needle_core.errors import UserError
from needle_core.ros.base_node import DiagnosticsPublisher
from needle_core.ros.conversions import JOINT_STATES, LATCHED, RELIABLE, to_nanoseconds, values_of
from needle_tracker.answers.tracker_messages import insertion_of, rotation_of

# Nothing of a rig is farther off, or less certain [m], [m^2]; what says so is not believed.
_FARTHEST = 10.0
_QUOTED = 40  # characters of a text that is not understood


class NeedleHearing:
    """The subscriptions that fill a `LiveNeedle`.

    Parameters
    ----------
    node : Node
        Who hears.
    diagnostics : DiagnosticsPublisher
        Where what is refused goes.

    Attributes
    ----------
    needle : LiveNeedle
        What is known.
    """

    def __init__(self, node: Node, diagnostics: DiagnosticsPublisher) -> None:
        self.needle = LiveNeedle()
        self._diagnostics = diagnostics
        hear = node.create_subscription
        hear(PoseWithCovarianceStamped, "needle/tip_pose", self._on_tip, RELIABLE)
        hear(JointState, "joint_states", self._on_joints, JOINT_STATES)
        hear(PoseWithCovarianceStamped, "needle/estimate", self._on_estimate, RELIABLE)
        hear(DiagnosticStatus, "needle/controller_status", self._on_controller, LATCHED)
        # A latched plane comes to whoever comes late, a plain one to the plain subscription alone.
        hear(PoseStamped, "target_plane", self._on_plane, RELIABLE)
        hear(
            PoseStamped,
            "target_plane",
            self._on_plane,
            LATCHED,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
        )

    def _on_joints(self, message: JointState) -> None:
        insertion = insertion_of(from_ros(messages.JointState, message))
        if insertion is not None and _is_near(insertion):
            self.needle.take_insertion(insertion)

    def _on_tip(self, message: PoseWithCovarianceStamped) -> None:
        stamp_ns = to_nanoseconds(message.header.stamp)
        place, _, covariance = _parts(message)
        q = message.pose.pose.orientation
        quaternion = np.array([q.x, q.y, q.z, q.w])
        if _is_near(place, covariance, quaternion):
            self.needle.take_tip(SeenTip(stamp_ns, place, quaternion, covariance))
        else:
            self.needle.take_no_tip(stamp_ns)

    def _on_estimate(self, message: PoseWithCovarianceStamped) -> None:
        place, rotation, covariance = _parts(message)
        if rotation is None or not _is_near(place, covariance):
            raise ValueError("no needle can be there, or it has no orientation")
        self.needle.take_belief(Belief(place, rotation, covariance))

    def _on_controller(self, message: DiagnosticStatus) -> None:
        values = values_of(message)
        offset, point = values.get("target_offset_m", ""), values.get("target_point_m", "")
        beside = float(offset) if offset else None
        x_y_z = np.array([float(part) for part in point.split(",")]) if point else None
        if not _is_near(beside or 0.0) or (x_y_z is not None and not _is_place(x_y_z)):
            raise ValueError(f"no target is at {offset[:_QUOTED]!r} and {point[:_QUOTED]!r}")
        self.needle.take_targets(beside, x_y_z)

    def _on_plane(self, message: PoseStamped) -> None:
        p, q = message.pose.position, message.pose.orientation
        try:
            plane = plane_from_pose(message.header.frame_id, [p.x, p.y, p.z], [q.x, q.y, q.z, q.w])
        except UserError as error:
            self._diagnostics.refuse("target_plane", "no plane", str(error))
            return
        self.needle.take_plane(plane)


def _is_near(*parts: Any) -> bool:
    """Return whether all numbers are finite, and such that a needle of a rig may have."""
    return all(bool(np.all(np.abs(part) <= _FARTHEST)) for part in parts)


def _is_place(values: Any) -> bool:
    return values.shape == (3,) and _is_near(values)


def _parts(message: PoseWithCovarianceStamped) -> tuple[Any, Any, Any]:
    """Return place, rotation (None: no orientation) and covariance of the place."""
    pose = from_ros(messages.PoseWithCovariance, message)
    covariance = np.array(pose.covariance).reshape(6, 6)[:3, :3]
    return np.array(pose.position), rotation_of(pose), covariance
