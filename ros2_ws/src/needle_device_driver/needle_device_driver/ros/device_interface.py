"""The `device/...` interface on a node: the same for real, emulated and simulated axes."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState, Joy
from std_msgs.msg import Bool, Header
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from needle_core.errors import UserError
from needle_core.process.claim import WAY_OUT, Claim
from needle_core.ros.base_node import STEADY_CLOCK, DiagnosticsPublisher
from needle_core.ros.bounded_subscription import listen
from needle_core.ros.conversions import (
    ESTOPS_HEARD,
    HOLDS_HEARD,
    JOINT_STATES,
    LATCHED,
    RELIABLE,
    to_stamp,
)
from needle_core.ros.discovery import publishers_of, signature
from needle_device_driver.device import device_status
from needle_device_driver.ros.conversions import (
    to_command,
    to_hold_message,
    to_joint_state,
    to_result,
    to_status,
)
from needle_device_driver.supervisor.reports import (
    DeviceStatus,
    Notice,
    NoticeLimit,
    Reply,
    StepResult,
)
from needle_device_driver.supervisor.supervisor import MotionSupervisor

# Positions alone change device/status so often at most [s]; joint_states has them all.
_STATUS_PERIOD = 0.5
# How often to look for another device when nothing else is heard [s].
_LOOK_PERIOD = 0.1


class DeviceInterface:
    """Connects a motion supervisor to the topics and services of `device/...`.

    Parameters
    ----------
    node : Node
        The node that gets publishers, subscriptions and services.
    supervisor : MotionSupervisor
        What they speak for.
    diagnostics : DiagnosticsPublisher
        Where the device's health goes.
    simulated : bool or None
        Whether no real needle can move; None until that is known.
    refuse : callable
        Returns why services are not ready yet, empty when they are; a stop, a disabling and an
        emergency stop are never refused.
    on_step_end : callable, optional
        Called after each result was published.

    Raises
    ------
    UserError
        If another process of this machine is a device on the same topics.
    """

    def __init__(
        self,
        node: Node,
        supervisor: MotionSupervisor,
        diagnostics: DiagnosticsPublisher,
        *,
        simulated: bool | None,
        refuse: Callable[[], str],
        on_step_end: Callable[[], None] = lambda: None,
    ) -> None:
        self._node = node
        self._supervisor = supervisor
        self._diagnostics = diagnostics
        self._refuse = refuse
        self._on_step_end = on_step_end
        self._told: DeviceStatus | None = None
        self._told_at = 0.0
        self._notices = NoticeLimit()
        self.simulated = simulated
        self._topic = node.resolve_topic_name("device/status")
        domain = node.context.get_domain_id()
        try:
            self._claim = Claim(
                f"{self._topic} of ROS_DOMAIN_ID {domain}", node.get_fully_qualified_name()
            )
        except UserError as error:
            raise UserError(f"another device is there: {error}; {WAY_OUT}") from None
        node.context.on_shutdown(self._claim.release)
        node.create_timer(_LOOK_PERIOD, self._look_around, clock=STEADY_CLOCK)
        self.joint_states = node.create_publisher(JointState, "joint_states", JOINT_STATES)
        self.results = node.create_publisher(Header, "device/result", RELIABLE)
        self.statuses = node.create_publisher(DiagnosticStatus, "device/status", LATCHED)
        self.publishers: list[Publisher[Any]] = [self.joint_states, self.results, self.statuses]
        too_long = diagnostics.refuse
        self.commands = listen(
            node,
            JointTrajectory,
            "device/joint_trajectory",
            self._on_commands,
            RELIABLE,
            refuse=too_long,
        )
        self.holds = listen(
            node, Joy, "device/hold", self._on_holds, HOLDS_HEARD, refuse=too_long, at_once=100
        )
        self.estops = listen(
            node, Bool, "device/estop", self._on_estops, ESTOPS_HEARD, refuse=too_long, at_once=1000
        )
        now = time.monotonic
        self._service("home", lambda: supervisor.home(now()))
        self._service("retract", lambda: supervisor.retract(now()))
        self._service("reset", lambda: supervisor.reset(now()))
        self._service("stop", supervisor.stop, always=True)
        self._switch("enable", lambda on: supervisor.enable(on, now()))
        self._switch("confirm_needle_out", supervisor.confirm_needle_out)
        self.report()

    def report(self) -> None:
        """Publish results and status changes; call it after each cycle."""
        for event in self._supervisor.take_events():
            if isinstance(event, StepResult):
                self.results.publish(to_result(event))
                self._on_step_end()
            elif isinstance(event, Notice):
                self._log(event)
        now = time.monotonic()
        status = dataclasses.replace(self._supervisor.status(now), simulated=self.simulated)
        told = self._told
        if told == status:
            return
        if (
            told is None
            or now - self._told_at > _STATUS_PERIOD
            or dataclasses.replace(status, insertion=told.insertion, rotation=told.rotation) != told
        ):
            self._tell(status, now)

    def _log(self, notice: Notice) -> None:
        text = self._notices.admit(notice, time.monotonic())
        # rclpy wants each place in the code to keep to one level.
        if text and notice.fault:
            self._node.get_logger().error(text)
        elif text:
            self._node.get_logger().warning(text)

    @property
    def others(self) -> str:
        """Names of other devices on the same topics, as far as discovery tells; empty: nobody."""
        if self._node.count_publishers(self._topic) <= 1:
            return ""
        names = publishers_of(self._node, self._topic)
        own = self._node.get_fully_qualified_name()
        if own in names:
            names.remove(own)
        return f"another device is there: {', '.join(names)} publishes {self._topic}; {WAY_OUT}"

    def close(self) -> None:
        """Let another process be the device on these topics."""
        self._claim.release()

    def _look_around(self) -> None:
        self._supervisor.see_others(self.others)
        self.report()

    def publish_joint_states(self, stamp_ns: int, now: float) -> None:
        """Publish the measured joints, unless they are stale.

        Parameters
        ----------
        stamp_ns : int
            When they were sampled [ns].
        now : float
            Steady time at which they must not be stale [s].
        """
        joints = self._supervisor.joints(now)
        if joints is not None:
            self.joint_states.publish(to_joint_state(joints, to_stamp(stamp_ns)))

    def _tell(self, status: DeviceStatus, now: float) -> None:
        told = self._told
        self._told, self._told_at = status, now
        self.statuses.publish(to_status(status, signature(self._node)))
        self._diagnostics.set("device", device_status(status, "").diagnostic)
        if told is None or told.state is not status.state:
            why = f" ({status.reason})" if status.reason else ""
            self._node.get_logger().debug(f"device: {status.state.value}{why}")

    def _on_commands(self, messages: list[JointTrajectory]) -> None:
        self._supervisor.see_others(self.others)
        for message in messages:
            self._supervisor.submit(
                to_command(message), time.monotonic(), self.commands.get_publisher_count()
            )
        self.report()

    def _on_holds(self, messages: list[Joy]) -> None:
        self._supervisor.see_others(self.others)
        for message in messages:
            self._supervisor.receive_hold(to_hold_message(message), time.monotonic())
        self.report()

    def _on_estops(self, messages: list[Bool]) -> None:
        for message in messages:
            self._supervisor.receive_estop(bool(message.data))
        self.report()

    def _service(self, name: str, call: Callable[[], Reply], *, always: bool = False) -> None:
        def answer(_: Any, response: Any) -> Any:
            return self._answer(response, call, always=always)

        self._node.create_service(Trigger, f"device/{name}", answer)

    def _switch(self, name: str, call: Callable[[bool], Reply]) -> None:
        def answer(request: Any, response: Any) -> Any:
            on = bool(request.data)
            return self._answer(response, lambda: call(on), always=not on)

        self._node.create_service(SetBool, f"device/{name}", answer)

    def _answer(self, response: Any, call: Callable[[], Reply], *, always: bool) -> Any:
        self._supervisor.see_others(self.others)
        why_not = "" if always else self._refuse()
        reply = Reply(False, why_not) if why_not else call()
        response.success, response.message = reply.success, reply.message
        self.report()
        return response
