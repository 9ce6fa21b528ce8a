"""The rows of a device on a node: the same for real, emulated and simulated axes."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Protocol

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from needle_core.component import (
    Action,
    Actions,
    Diagnose,
    Input,
    Log,
    Moment,
    Output,
    Peers,
    Publish,
    Reply,
    Service,
)
from needle_core.convert import Converter, from_ros, ros_type
from needle_core.diagnostics import Diagnostic, Level
from needle_core.errors import UserError
from needle_core.message_types import rclpy_types
from needle_core.process.claim import WAY_OUT, Claim
from needle_core.ros.base_node import STEADY_CLOCK, DiagnosticsPublisher
from needle_core.ros.bounded_subscription import listen
from needle_core.ros.conversions import to_qos
from needle_core.ros.discovery import publishers_of, signature
from needle_device_driver.device import COMMANDS, RESULT, STATUS, STOP

# How often to look for another device when nothing else is heard [s].
_LOOK_PERIOD = 0.1


class Device(Protocol):
    """A device's rows."""

    inputs: Sequence[Input]
    outputs: Sequence[Output]
    services: Sequence[Service]

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Note who else is a device here, and how many send commands."""


class DeviceInterface:
    """Connects a device's rows to topics and services, and carries its actions out.

    Parameters
    ----------
    node : Node
        The node that gets publishers, subscriptions and services.
    device : Device
        Whose rows.
    diagnostics : DiagnosticsPublisher
        Where the device's health goes.
    refuse : callable
        Returns why services are not ready yet, empty when they are; a stop, a disabling and an
        emergency stop are never refused.
    on_step_end : callable, optional
        Called after each result was published.
    carry_out : callable, optional
        Takes what is left of a handler's actions.

    Raises
    ------
    UserError
        If another process of this machine is a device on the same topics.
    """

    def __init__(
        self,
        node: Node,
        device: Device,
        diagnostics: DiagnosticsPublisher,
        *,
        refuse: Callable[[], str],
        on_step_end: Callable[[], None] = lambda: None,
        carry_out: Callable[[Action], None] = lambda action: None,
    ) -> None:
        self._node = node
        self._device = device
        self._diagnostics = diagnostics
        self._refuse = refuse
        self._on_step_end = on_step_end
        self._carry_out = carry_out
        self._failures = 0
        self._numbers = itertools.count(1)
        self._replies: dict[int, Future[Reply]] = {}
        domain = node.context.get_domain_id()
        topic = node.resolve_topic_name(STATUS)
        try:
            self._claim = Claim(
                f"{topic} of ROS_DOMAIN_ID {domain}", node.get_fully_qualified_name()
            )
        except UserError as error:
            raise UserError(f"another device is there: {error}; {WAY_OUT}") from None
        node.context.on_shutdown(self._claim.release)
        node.create_timer(_LOOK_PERIOD, self.look_around, clock=STEADY_CLOCK)
        self._types = rclpy_types()
        self._converter = Converter(self._types)
        self._publishers = {
            row.topic: node.create_publisher(
                self._types.make(ros_type(row.message)), row.topic, to_qos(row.delivery)
            )
            for row in device.outputs
        }
        self.publishers = list(self._publishers.values())
        self._subscriptions = {row.topic: self._hear(row) for row in device.inputs}
        for service in device.services:
            node.create_service(
                SetBool if service.has_argument else Trigger,
                service.name,
                partial(self._answer, service),
                # What is not answered at once holds up nobody.
                callback_group=ReentrantCallbackGroup(),
            )
        self.look_around()

    def subscription(self, topic: str) -> Subscription[Any]:
        """Return the subscription to a topic."""
        return self._subscriptions[topic]

    def close(self) -> None:
        """Let another process be the device on these topics."""
        self._claim.release()

    def moment(self) -> Moment:
        """Return the present moment."""
        return Moment(time.monotonic(), self._node.get_clock().now().nanoseconds)

    def do(self, actions: Actions) -> bool:
        """Carry out a handler's actions; return whether it did not raise, which is told."""
        steps = iter(actions)
        while True:
            try:
                action = next(steps, None)
            # Whatever a message may lead to.
            except Exception as error:  # noqa: BLE001
                self._failures += 1
                text = f"internal error: {type(error).__name__}: {error}"
                self._node.get_logger().error(text)
                values = {"failures": str(self._failures)}
                self._diagnostics.set("handlers", Diagnostic(Level.ERROR, text, values))
                return False
            if action is None:
                return True
            self._do(action)

    def _do(self, action: Action) -> None:
        match action:
            case Publish(topic, message):
                self._publishers[topic].publish(self._converter.to_ros(message))
                if topic == RESULT:
                    self._on_step_end()
            case Diagnose(part, diagnostic):
                self._diagnostics.set(part, diagnostic)
            case Reply(number):
                if number in self._replies:
                    self._replies.pop(number).set_result(action)
            # rclpy wants each place in the code to keep to one level.
            case Log("error", text):
                self._node.get_logger().error(text)
            case Log("warning", text):
                self._node.get_logger().warning(text)
            case Log(_, text):
                self._node.get_logger().info(text)
            case _:
                self._carry_out(action)

    def _hear(self, row: Input) -> Subscription[Any]:
        return listen(
            self._node,
            self._types.make(ros_type(row.message)),
            row.topic,
            partial(self._on_messages, row),
            to_qos(row.delivery),
            refuse=self._diagnostics.refuse,
            # Of commands one: each is a lot of work.
            at_once=1 if row.topic == COMMANDS else row.delivery.depth,
        )

    def _on_messages(self, row: Input, messages: list[Any]) -> None:
        self.look_around()
        for message in messages:
            self.do(row.handler(from_ros(row.message, message), self.moment()))

    async def _answer(self, service: Service, request: Any, response: Any) -> Any:
        self.look_around()
        argument = bool(request.data) if service.has_argument else None
        reply = await self._ask(service, argument)
        response.success, response.message = reply.success, reply.text
        return response

    def _ask(self, service: Service, argument: bool | None) -> Future[Reply]:
        number = next(self._numbers)
        future = self._replies[number] = Future()
        why_not = "" if service.name == STOP or argument is False else self._refuse()
        if why_not:
            self._do(Reply(number, False, why_not))
        elif not self.do(service.handler(argument, number, self.moment())):
            self._do(Reply(number, False, "internal error"))
        return future

    def look_around(self) -> None:
        """Tell the device who else is one, and how many send commands."""
        own, others = self._node.get_fully_qualified_name(), []
        if self._node.count_publishers(STATUS) > 1:
            others = publishers_of(self._node, STATUS)
            if own in others:
                others.remove(own)
        senders = self._node.count_publishers(COMMANDS)
        publishers = {STATUS: (signature(self._node), *others), COMMANDS: ("",) * senders}
        self.do(self._device.on_peers(Peers(publishers), self.moment()))
