"""plane_controller: measured tips in, one insertion step at a time out."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections import deque
from collections.abc import Iterable
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.context import Context
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.parameter import Parameter
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from needle_common.diagnostics import Diagnostic, Level
from needle_common.process.watched_time import WatchedTime
from needle_common.ros.base_node import STEADY_CLOCK, DiagnosticsPublisher, run_node
from needle_common.ros.conversions import LATCHED, RELIABLE, to_diagnostic_status
from needle_common.ros.discovery import (
    AnsweringNodes,
    signature,
    unheard,
    unpublished,
    unrecorded,
)
from needle_common.ros.life_signs import LifeSigns
from needle_common.ros.parameters import NodeParameters
from needle_common.ros.topic_input import TopicInput
from needle_common.ros.whole_node import WholeNode
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.heard_messages import HeardMessages
from needle_controller.protocol.steering_types import Action, Log, SteeringState
from needle_controller.ros import conversions
from needle_controller.ros.conversions import TARGET_PLANE, TARGET_POINT
from needle_controller.ros.obstacle_messages import OBSTACLES
from needle_controller.ros.steering_messages import OUTPUTS, SteeringMessages, output_messages

HELP = """
plane_controller: steers the needle into the target plane, or to the target point, one insertion
step per measured tip.

Subscribes  needle/tip, needle/tip_pose (its covariance), target_plane, target_point, obstacles,
            joint_states, device/result, device/status
Publishes   device/joint_trajectory, needle/estimate, needle/reduced_state, needle/linearized_state,
            needle/control_input, needle/controller_status, /diagnostics
Services    ~/start, ~/stop
"""

# Steady time between two lines of log of one kind [s]: never every cycle.
_LOG_PERIOD = 2.0
_TARGETS = (TARGET_PLANE, TARGET_POINT, OBSTACLES)
_TARGETS_SEEN = 32


class PlaneControllerNode(WholeNode):
    """The ROS shell of `SteeringMessages`: hears, publishes, reports.

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
        self._settings = NodeParameters(self, SteeringSettings, self._on_parameters)
        values = self._settings.values
        self._messages = SteeringMessages(values)
        self._steering = self._messages.steering
        self._heard = HeardMessages()
        self._logged: dict[str, float] = {}
        self._published: Diagnostic | None = None

        self._diagnostics = DiagnosticsPublisher(self)
        self._outputs = {
            topic: self.create_publisher(kind, topic, RELIABLE) for topic, kind in OUTPUTS.items()
        }
        self._status = self.create_publisher(DiagnosticStatus, "needle/controller_status", LATCHED)
        # A latched target reaches whoever comes late; DDS gives a latched subscription nothing of a
        # plain publisher (`ros2 topic pub`, RViz), a plain one what both send from now on.
        self._targets_seen: deque[tuple[str, int]] = deque(maxlen=_TARGETS_SEEN)
        for topic in _TARGETS:
            self._hear(dataclasses.replace(self._messages.inputs[topic], qos=RELIABLE))
        sources = {row.topic: self._hear(row) for row in self._messages.inputs.values()}
        not_awaited = {*_TARGETS}
        if values.tip_covariance != "from_tip_pose":
            not_awaited.add("needle/tip_pose")
        self._sources = [heard for topic, heard in sources.items() if topic not in not_awaited]
        self._partners = AnsweringNodes(self)
        self.create_service(Trigger, "~/start", self._on_start)
        self.create_service(Trigger, "~/stop", self._on_stop)
        self._watched = WatchedTime()
        self.create_timer(0.1, self._on_timer, clock=STEADY_CLOCK)
        self._life = LifeSigns(
            self,
            self._diagnostics,
            f"preset {values.controller}",
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
        commands = self._outputs["device/joint_trajectory"]
        no_device = unheard(self, [commands.topic_name])
        if not self._settings.values.wait_for_recorder:
            return no_device
        mine = (*self._outputs.values(), self._status)
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

    def _hear(self, row: TopicInput[Action]) -> Subscription[Any]:
        """Subscribe to a topic."""
        return self.create_subscription(
            row.kind,
            row.topic,
            partial(self._on_message, row.topic),
            row.qos,
            event_callbacks=SubscriptionEventCallbacks(
                # A plain publisher of targets is heard by the plain subscription.
                use_default_callbacks=row.topic not in _TARGETS or row.qos != LATCHED
            ),
        )

    def _on_message(self, topic: str, message: Any, info: dict[str, int]) -> None:
        sent_ns = info["source_timestamp"]
        if topic in _TARGETS:
            if (topic, sent_ns) in self._targets_seen:
                # Of the other subscription.
                return
            self._targets_seen.append((topic, sent_ns))
        self._heard.add(topic, sent_ns)
        self._do(self._messages.inputs[topic].take(message, sent_ns))

    def _on_parameters(self, values: SteeringSettings) -> None:
        self._steering.configure(values)
        self._do([Log("info", "parameters changed")])

    def _on_timer(self) -> None:
        self._do(self._steering.on_time(self._watched.read(time.monotonic())))

    def _do(self, actions: Iterable[Action]) -> None:
        for action in actions:
            if isinstance(action, Log):
                self._log(action)
                continue
            for topic, message in output_messages(action):
                self._outputs[topic].publish(message)
        self._report()

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
            "joint_states_refused": str(self._messages.bad_joints),
            "joint_states_doubted": str(history.doubted),
        }
        complaint = self._messages.joints_complaint or history.complaint
        self._diagnostics.set("joint_states", _health(complaint, joints))
        self._diagnostics.set(TARGET_PLANE, _health(self._messages.plane_complaint, {}))
        self._diagnostics.set(TARGET_POINT, _health(self._messages.point_complaint, {}))
        self._diagnostics.set(OBSTACLES, _health(self._messages.obstacles_complaint, {}))
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
    return run_node(PlaneControllerNode, help_text=HELP, parameters=SteeringSettings, args=args)


if __name__ == "__main__":
    sys.exit(main())
