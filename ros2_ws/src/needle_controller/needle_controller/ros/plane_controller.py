"""The `plane_controller` executable: the component `PlaneController` as a ROS node."""

from __future__ import annotations

import sys
import time
from collections import deque
from functools import partial
from typing import Any

from rclpy.context import Context
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from needle_controller.plane_controller import COMMANDS, STATUS, TARGETS, PlaneController
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.steering_types import SteeringState
from needle_core.component import Actions, Diagnose, Input, Log, Moment, Publish
from needle_core.convert import Converter, from_ros, ros_type
from needle_core.message_types import rclpy_types
from needle_core.process.watched_time import WatchedTime
from needle_core.ros.base_node import STEADY_CLOCK, DiagnosticsPublisher, run_node
from needle_core.ros.conversions import LATCHED, RELIABLE, to_qos
from needle_core.ros.discovery import (
    AnsweringNodes,
    signature,
    unheard,
    unpublished,
    unrecorded,
)
from needle_core.ros.life_signs import LifeSigns
from needle_core.ros.parameters import NodeParameters
from needle_core.ros.whole_node import WholeNode

HELP = """
plane_controller: steers the needle into the target plane, or to the target point, one insertion
step per measured tip.

Subscribes  needle/tip, needle/tip_pose (its covariance), target_plane, target_point, obstacles,
            joint_states, device/result, device/status
Publishes   device/joint_trajectory, needle/estimate, needle/reduced_state, needle/linearized_state,
            needle/control_input, needle/controller_status, /diagnostics
Services    ~/start, ~/stop
"""

_TARGETS_SEEN = 32


class PlaneControllerNode(WholeNode):
    """The ROS shell of `PlaneController`: hears, publishes, reports.

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
        self._component = PlaneController(values, signature(self))
        self._types = rclpy_types()
        self._converter = Converter(self._types)
        self._diagnostics = DiagnosticsPublisher(self)
        self._outputs = {
            row.topic: self.create_publisher(
                self._types.make(ros_type(row.message)), row.topic, to_qos(row.delivery)
            )
            for row in self._component.outputs
        }
        # A latched target reaches whoever comes late; DDS gives a latched subscription nothing of a
        # plain publisher (`ros2 topic pub`, RViz), a plain one what both send from now on.
        self._targets_seen: deque[tuple[str, int]] = deque(maxlen=_TARGETS_SEEN)
        for row in self._component.inputs:
            if row.topic in TARGETS:
                self._hear(row, RELIABLE)
        sources = {
            row.topic: self._hear(row, to_qos(row.delivery)) for row in self._component.inputs
        }
        not_awaited = {*TARGETS}
        if values.tip_covariance != "from_tip_pose":
            not_awaited.add("needle/tip_pose")
        self._sources = [heard for topic, heard in sources.items() if topic not in not_awaited]
        self._partners = AnsweringNodes(self)
        self.create_service(Trigger, "~/start", self._on_start)
        self.create_service(Trigger, "~/stop", self._on_stop)
        self._watched = WatchedTime()
        for timer in self._component.timers:
            run = partial(self._on_timer, timer.handler)
            self.create_timer(timer.period, run, clock=STEADY_CLOCK)
        self._life = LifeSigns(
            self,
            self._diagnostics,
            f"preset {values.controller}",
            self._waits_for,
            alone_on=(COMMANDS, STATUS),
        )
        self._do(self._component.carry_out([], self._moment()))

    def _moment(self, sent_ns: int = 0) -> Moment:
        return Moment(time.monotonic(), self.get_clock().now().nanoseconds, sent_ns)

    def _on_start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        missing = self._missing()
        if missing:
            response.success = False
            response.message = f"waiting for {', '.join(missing)}"
            return response
        reply, actions = self._component.start(self._moment())
        self._do(actions)
        response.success, response.message = reply.success, reply.message
        return response

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        reply, actions = self._component.stop(self._moment())
        self._do(actions)
        response.success, response.message = reply.success, reply.message
        return response

    def _missing(self) -> list[str]:
        """Return who must be there before a message counts: the device, and for a bag everybody.

        A device that is heard may not know yet who commands it; the first step would be lost.
        """
        no_device = unheard(self, [self._outputs[COMMANDS].topic_name])
        if not self._settings.values.wait_for_recorder:
            return no_device
        return [
            *self._partners.unaware_sources(self._sources),
            *no_device,
            *unrecorded(self, self._outputs.values()),
        ]

    def _waits_for(self) -> list[str]:
        missing = list(dict.fromkeys(self._missing() + unpublished(self, self._sources)))
        if missing or self._component.steering.state is not SteeringState.IDLE:
            return missing
        return [f"service call {self.resolve_service_name('~/start')}"]

    def _hear(self, row: Input, qos: QoSProfile) -> Subscription[Any]:
        """Subscribe to a topic."""
        return self.create_subscription(
            self._types.make(ros_type(row.message)),
            row.topic,
            partial(self._on_message, row),
            qos,
            event_callbacks=SubscriptionEventCallbacks(
                # A plain publisher of targets is heard by the plain subscription.
                use_default_callbacks=row.topic not in TARGETS or qos != LATCHED
            ),
        )

    def _on_message(self, row: Input, message: Any, info: dict[str, int]) -> None:
        sent_ns = info["source_timestamp"]
        if row.topic in TARGETS:
            if (row.topic, sent_ns) in self._targets_seen:
                # Of the other subscription.
                return
            self._targets_seen.append((row.topic, sent_ns))
        self._do(row.handler(from_ros(row.message, message), self._moment(sent_ns)))

    def _on_parameters(self, values: SteeringSettings) -> None:
        self._do(self._component.on_settings(values, self._moment()))

    def _on_timer(self, handler: Any) -> None:
        steady = self._watched.read(time.monotonic())
        self._do(handler(Moment(steady, self.get_clock().now().nanoseconds)))

    def _do(self, actions: Actions) -> None:
        for action in actions:
            match action:
                case Publish(topic, message):
                    self._outputs[topic].publish(self._converter.to_ros(message))
                case Diagnose(part, diagnostic):
                    self._diagnostics.set(part, diagnostic)
                case Log(severity, text):
                    self._log(severity, text)

    def _log(self, severity: str, text: str) -> None:
        # Not one call through a variable: rclpy knows a line by where it is called from.
        if severity == "error":
            self.get_logger().error(text)
        elif severity == "warning":
            self.get_logger().warning(text)
        else:
            self.get_logger().info(text)


def main(args: list[str] | None = None) -> int:
    """Run the node; returns its exit code."""
    return run_node(PlaneControllerNode, help_text=HELP, parameters=SteeringSettings, args=args)


if __name__ == "__main__":
    sys.exit(main())
