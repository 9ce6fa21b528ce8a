"""plane_controller: measured tips in, one insertion step at a time out."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections import deque
from collections.abc import Iterable
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import (
    PointStamped,
    PoseStamped,
    PoseWithCovarianceStamped,
    Vector3Stamped,
)
from rclpy.context import Context
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.parameter import Parameter
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from needle_common.diagnostics import Diagnostic, Level
from needle_common.errors import UserError
from needle_common.ros.base_node import STEADY_CLOCK, DiagnosticsPublisher, run_node
from needle_common.ros.conversions import (
    JOINT_STATES,
    LATCHED,
    RELIABLE,
    to_diagnostic_status,
    to_nanoseconds,
)
from needle_common.ros.discovery import (
    AnsweringNodes,
    signature,
    unheard,
    unpublished,
    unrecorded,
)
from needle_common.ros.life_signs import LifeSigns
from needle_common.ros.parameters import NodeParameters
from needle_common.ros.whole_node import WholeNode
from needle_controller.protocol.heard_messages import HeardMessages
from needle_controller.protocol.steering_types import (
    Action,
    Log,
    PublishUpdate,
    SendStep,
    SteeringState,
)
from needle_controller.ros import conversions
from needle_controller.ros.parameters import PlaneControllerParameters

HELP = """
plane_controller: steers the needle into the target plane, one insertion step per measured tip.

Subscribes  needle/tip, needle/tip_pose (its covariance), target_plane, joint_states, device/result,
            device/status
Publishes   device/joint_trajectory, needle/estimate, needle/reduced_state, needle/linearized_state,
            needle/control_input, needle/controller_status, /diagnostics
Services    ~/start, ~/stop
"""

# Steady time between two lines of log of one kind [s]: never every cycle.
_LOG_PERIOD = 2.0
_PLANES_SEEN = 32


class PlaneControllerNode(WholeNode):
    """The ROS shell of `steering.Steering`: converts, calls, publishes, reports.

    Parameters
    ----------
    context : Context, optional
        Where the node lives; the global context by default.
    parameter_overrides : list of Parameter, optional
        Parameters beside those of the command line.

    Raises
    ------
    UserError
        A parameter that is unknown, of the wrong type, out of bounds, or part of a bad whole.
    """

    def __init__(
        self,
        context: Context | None = None,
        parameter_overrides: list[Parameter] | None = None,
    ) -> None:
        super().__init__(
            "plane_controller", context=context, parameter_overrides=parameter_overrides
        )
        self._settings = NodeParameters(self, PlaneControllerParameters, self._on_parameters)
        values = self._settings.values
        self._steering_has = values
        self._steering = values.make_steering()
        self._heard = HeardMessages()
        self._logged: dict[str, float] = {}
        self._bad_joints = 0
        self._joints_complaint = ""
        self._plane_complaint = ""
        self._published: Diagnostic | None = None

        self._diagnostics = DiagnosticsPublisher(self)
        self._commands = self.create_publisher(JointTrajectory, "device/joint_trajectory", RELIABLE)
        self._estimates = self.create_publisher(
            PoseWithCovarianceStamped, "needle/estimate", RELIABLE
        )
        self._reduced = self.create_publisher(Vector3Stamped, "needle/reduced_state", RELIABLE)
        self._linearized = self.create_publisher(
            Vector3Stamped, "needle/linearized_state", RELIABLE
        )
        self._inputs = self.create_publisher(Vector3Stamped, "needle/control_input", RELIABLE)
        self._status = self.create_publisher(DiagnosticStatus, "needle/controller_status", LATCHED)
        self._sources: list[Subscription[Any]] = [
            self.create_subscription(JointState, "joint_states", self._on_joints, JOINT_STATES),
            self.create_subscription(DiagnosticStatus, "device/status", self._on_device, LATCHED),
            self.create_subscription(Header, "device/result", self._on_result, RELIABLE),
            self.create_subscription(PointStamped, "needle/tip", self._on_tip, RELIABLE),
        ]
        # A latched plane reaches whoever comes late; DDS gives a latched subscription nothing of a
        # plain publisher (`ros2 topic pub`, RViz), a plain one what both send from now on.
        self._planes_seen: deque[int] = deque(maxlen=_PLANES_SEEN)
        for qos in (LATCHED, RELIABLE):
            self.create_subscription(
                PoseStamped,
                "target_plane",
                self._on_plane,
                qos,
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=qos is RELIABLE),
            )
        tip_poses = self.create_subscription(
            PoseWithCovarianceStamped, "needle/tip_pose", self._on_tip_pose, RELIABLE
        )
        if values.tip_covariance == "from_tip_pose":
            self._sources.append(tip_poses)
        self._partners = AnsweringNodes(self)
        self.create_service(Trigger, "~/start", self._on_start)
        self.create_service(Trigger, "~/stop", self._on_stop)
        self.create_timer(0.1, self._on_timer, clock=STEADY_CLOCK)
        self._life = LifeSigns(
            self,
            self._diagnostics,
            f"preset {values.preset}",
            self._waits_for,
            alone_on=("device/joint_trajectory", "needle/controller_status"),
        )
        self._do([])

    def _on_start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        missing = self._missing()
        if missing:
            response.success = False
            response.message = f"waiting for {', '.join(missing)}"
            return response
        reply, actions = self._steering.on_start()
        self._do(actions)
        response.success, response.message = reply.success, reply.message
        return response

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        reply, actions = self._steering.on_stop()
        self._do(actions)
        response.success, response.message = reply.success, reply.message
        return response

    def _missing(self) -> list[str]:
        """Return who must be there before a message counts: the device, and for a bag everybody.

        A device that is heard may not know yet who commands it; the first step would be lost.
        """
        no_device = unheard(self, [self._commands.topic_name])
        if not self._settings.values.wait_for_recorder:
            return no_device
        mine = (
            self._commands,
            self._estimates,
            self._reduced,
            self._linearized,
            self._inputs,
            self._status,
        )
        return [
            *self._partners.unaware_sources(self._sources),
            *no_device,
            *unrecorded(self, mine),
        ]

    def _waits_for(self) -> list[str]:
        missing = list(dict.fromkeys(self._missing() + unpublished(self, self._sources)))
        if missing or self._steering.state is not SteeringState.IDLE:
            return missing
        return [f"service call {self.resolve_service_name('~/start')}"]

    def _hear(self, topic: str, info: dict[str, int]) -> int:
        """Note what is heard; return when it was sent [ns]."""
        sent_ns = info["source_timestamp"]
        self._heard.add(topic, sent_ns)
        return sent_ns

    def _on_joints(self, message: JointState, info: dict[str, int]) -> None:
        sent_ns = self._hear("joint_states", info)
        try:
            sample = conversions.to_joint_sample(message, sent_ns)
        except UserError as error:
            self._bad_joints += 1
            self._joints_complaint = str(error)
            self._do([Log("warning", str(error), "joints")])
            return
        self._joints_complaint = ""
        self._do(self._steering.on_joints(sample))

    def _on_tip(self, message: PointStamped, info: dict[str, int]) -> None:
        self._hear("needle/tip", info)
        self._do(self._steering.on_tip(conversions.to_tip(message)))

    def _on_tip_pose(self, message: PoseWithCovarianceStamped, info: dict[str, int]) -> None:
        self._hear("needle/tip_pose", info)
        self._do(self._steering.on_tip_pose(conversions.to_tip_covariance(message)))

    def _on_result(self, message: Header, info: dict[str, int]) -> None:
        sent_ns = self._hear("device/result", info)
        stamp_ns = to_nanoseconds(message.stamp)
        self._do(self._steering.on_result(stamp_ns, message.frame_id, sent_ns))

    def _on_device(self, message: DiagnosticStatus, info: dict[str, int]) -> None:
        self._hear("device/status", info)
        self._do(self._steering.on_device(conversions.to_device_status(message)))

    def _on_plane(self, message: PoseStamped, info: dict[str, int]) -> None:
        sent_at = info["source_timestamp"]
        if sent_at in self._planes_seen:
            # Of the other subscription.
            return
        self._planes_seen.append(sent_at)
        self._hear("target_plane", info)
        try:
            plane = conversions.to_plane(message)
            self._settings.values.check_plane(plane)
        except UserError as error:
            self._plane_complaint = f"{error}; the last plane stays"
            self._do([Log("warning", self._plane_complaint)])
            return
        self._plane_complaint = ""
        self._steering.control.plane = plane
        self._do([Log("info", f"target_plane at offset {plane.offset:g} m")])

    def _on_parameters(self, values: PlaneControllerParameters) -> None:
        values.change_steering(self._steering, self._steering_has)
        self._steering_has = values
        self._do([Log("info", "parameters changed")])

    def _on_timer(self) -> None:
        self._do(self._steering.on_time(time.monotonic()))

    def _do(self, actions: Iterable[Action]) -> None:
        for action in actions:
            if isinstance(action, SendStep):
                self._commands.publish(conversions.to_trajectory(action))
            elif isinstance(action, PublishUpdate):
                self._publish_update(action)
            else:
                self._log(action)
        self._report()

    def _publish_update(self, action: PublishUpdate) -> None:
        update, stamp_ns = action.update, action.stamp_ns
        estimate = update.estimate
        self._estimates.publish(conversions.to_pose(estimate, stamp_ns))
        self._reduced.publish(conversions.to_vector(estimate.reduced, stamp_ns))
        self._linearized.publish(conversions.to_vector(estimate.linearized, stamp_ns))
        self._inputs.publish(conversions.to_control_input(update, stamp_ns))

    def _log(self, log: Log) -> None:
        now = time.monotonic()
        if log.kind:
            if now - self._logged.get(log.kind, -_LOG_PERIOD) < _LOG_PERIOD:
                return
            self._logged[log.kind] = now
        # Not one call through a variable: rclpy knows a line by where it is called from.
        if log.severity == "error":
            self.get_logger().error(log.text)
        elif log.severity == "warning":
            self.get_logger().warning(log.text)
        else:
            self.get_logger().info(log.text)

    def _report(self) -> None:
        history = self._steering.intake.joints
        joints = {
            "joint_states_refused": str(self._bad_joints),
            "joint_states_doubted": str(history.doubted),
        }
        complaint = self._joints_complaint or history.complaint
        self._diagnostics.set("joint_states", _health(complaint, joints))
        self._diagnostics.set("target_plane", _health(self._plane_complaint, {}))
        diagnostic = conversions.to_diagnostic(self._steering, self._settings.values.preset)
        self._diagnostics.set("steering", diagnostic)
        if diagnostic != self._published or self._heard.is_full:
            self._published = diagnostic
            name = signature(self)
            values = {**diagnostic.values, "heard": self._heard.take_text()}
            told = dataclasses.replace(diagnostic, values=values)
            self._status.publish(to_diagnostic_status(f"{name}: steering", name, told))


def _health(complaint: str, values: dict[str, str]) -> Diagnostic:
    return Diagnostic(Level.WARN if complaint else Level.OK, complaint or "ok", values)


def main(args: list[str] | None = None) -> int:
    """Run the node; returns its exit code."""
    return run_node(
        PlaneControllerNode, help_text=HELP, parameters=PlaneControllerParameters, args=args
    )


if __name__ == "__main__":
    sys.exit(main())
