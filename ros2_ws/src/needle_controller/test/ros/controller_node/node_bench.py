"""The node under test, and around it what a rig publishes."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import (
    PointStamped,
    PoseStamped,
    PoseWithCovarianceStamped,
    Vector3Stamped,
)
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from needle_controller.plane_controller import PlaneController
from needle_controller.presets.steering_settings import SteeringSettings
from needle_core.diagnostics import Diagnostic, Level
from needle_core.ros.component_node import ComponentNode
from needle_core.ros.conversions import (
    JOINT_STATES,
    LATCHED,
    RELIABLE,
    to_diagnostic_status,
    to_nanoseconds,
    to_stamp,
    values_of,
)

LIMIT = 20.0
TICK = 20_000_000


class Bench:
    """The node under test, a scripted device and a scripted tracker, on one executor."""

    def __init__(self, context: Context, **parameters: Any) -> None:
        # most tests send tips alone
        given = {"tip_covariance": "configured", **parameters}
        self.node = ComponentNode(
            "plane_controller",
            SteeringSettings,
            PlaneController,
            context=context,
            parameter_overrides=[Parameter(name, value=v) for name, v in given.items()],
        )
        assert isinstance(self.node.component, PlaneController)
        self.steering = self.node.component.steering
        self.outside = outside = Node("outside", context=context)
        self._executor = SingleThreadedExecutor(context=context)
        for node in (self.node, outside):
            self._executor.add_node(node)
        self.received: defaultdict[str, list[Any]] = defaultdict(list)
        for kind, topic, qos in (
            (JointTrajectory, "device/joint_trajectory", RELIABLE),
            (PoseWithCovarianceStamped, "needle/estimate", RELIABLE),
            (Vector3Stamped, "needle/reduced_state", RELIABLE),
            (Vector3Stamped, "needle/linearized_state", RELIABLE),
            (Vector3Stamped, "needle/control_input", RELIABLE),
            (DiagnosticStatus, "needle/controller_status", LATCHED),
            (DiagnosticArray, "/diagnostics", RELIABLE),
        ):
            outside.create_subscription(kind, topic, self.received[topic].append, qos)
        self._joints = outside.create_publisher(JointState, "joint_states", JOINT_STATES)
        self._tips = outside.create_publisher(PointStamped, "needle/tip", RELIABLE)
        self._results = outside.create_publisher(Header, "device/result", RELIABLE)
        self._device = outside.create_publisher(DiagnosticStatus, "device/status", LATCHED)
        self._planes = outside.create_publisher(PoseStamped, "target_plane", LATCHED)
        self._points = outside.create_publisher(PointStamped, "target_point", LATCHED)
        self.obstacles = outside.create_publisher(MarkerArray, "obstacles", LATCHED)
        self.now = TICK
        self.insertion = self.rotation = 0.0
        publishers = (
            self._joints,
            self._tips,
            self._results,
            self._device,
            self._planes,
            self._points,
        )
        self.until(lambda: all(p.get_subscription_count() for p in publishers))
        self.until(lambda: "device/joint_trajectory" in self.node.peers.subscribers)
        self.until(lambda: bool(self.received["needle/controller_status"]))

    def close(self) -> None:
        for node in (self.node, self.outside):
            self._executor.remove_node(node)
            node.destroy_node()
        self._executor.shutdown()

    def until(self, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < end, f"waited in vain; {self.status}"
            self._executor.spin_once(timeout_sec=0.05)

    @property
    def status(self) -> dict[str, str]:
        messages = self.received["needle/controller_status"]
        return values_of(messages[-1]) if messages else {}

    @property
    def commands(self) -> list[JointTrajectory]:
        return self.received["device/joint_trajectory"]

    def health(self, part: str) -> tuple[int, str]:
        for array in reversed(self.received["/diagnostics"]):
            for status in array.status:
                if status.name == f"plane_controller: {part}":
                    return status.level[0], status.message
        return -1, ""

    def health_values(self, part: str) -> dict[str, str]:
        for array in reversed(self.received["/diagnostics"]):
            for status in array.status:
                if status.name == f"plane_controller: {part}":
                    return values_of(status)
        return {}

    def device(self, state: str = "HOLDING", owner: str = "operator") -> None:
        values = {"state": state, "homed": "true", "hold_owner": owner}
        health = Diagnostic(Level.OK, state, values)
        self._device.publish(to_diagnostic_status("device: device", "device", health))

    def joints(self) -> None:
        message = JointState(
            name=["rotation_joint", "insertion_joint"], position=[self.rotation, self.insertion]
        )
        message.header.stamp = to_stamp(self.now)
        self._joints.publish(message)

    def call(self, service: str) -> Trigger.Response:
        client = self.outside.create_client(Trigger, f"plane_controller/{service}")
        self.until(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        self.until(future.done)
        return future.result()

    def start(self) -> None:
        self.device()
        self.joints()
        steering = self.steering
        self.until(
            lambda: steering.intake.joints.latest is not None and steering._device is not None
        )
        response = self.call("start")
        assert response.success, response.message
        self.until(lambda: self.status["awaiting"] == "tip")

    def tip(self, position: list[float], frame: str = "rig", stamp: int | None = None) -> int:
        """Publish a tip one tick later, joints first; its stamp."""
        self.now += TICK
        self.joints()
        message = PointStamped()
        stamp = self.now if stamp is None else stamp
        message.header.stamp, message.header.frame_id = to_stamp(stamp), frame
        message.point.x, message.point.y, message.point.z = position
        self._tips.publish(message)
        return stamp

    def step(self) -> JointTrajectory:
        """One good tip and the command it leads to."""
        wanted = len(self.commands) + 1
        stamp = self.tip([0.0, 0.0, self.insertion])
        self.until(lambda: len(self.commands) >= wanted)
        command = self.commands[-1]
        assert to_nanoseconds(command.header.stamp) == stamp
        return command

    def run(self, command: JointTrajectory) -> None:
        """Carry it out, and answer."""
        self.insertion, self.rotation = command.points[0].positions
        self.now += TICK
        self.joints()
        answer = Header(stamp=command.header.stamp, frame_id="succeeded")
        self._results.publish(answer)
        self.until(lambda: self.status["tip_after_ns"] == str(self.now))
