"""A node that replaces the operator: calls services, holds, and records the needle's motion."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState, Joy
from std_srvs.srv import SetBool, Trigger

from needle_core.convert import to_ros
from needle_core.errors import UserError
from needle_core.message_types import rclpy_types
from needle_core.messages import HoldSession
from needle_core.process.discovery import restrict_discovery
from needle_core.ros.base_node import (
    HOLD,
    JOINT_STATES,
    LATCHED,
    STEADY_CLOCK,
    WholeNode,
    values_of,
)

TIMEOUT = 20.0
CONTROLLER_START = "plane_controller/start"
_HOLD_PERIOD = 0.05
# Threshold of a motion, below any set-point and above rounding [m].
_STILL = 1e-9
_SERVICES = {
    **dict.fromkeys(("device/home", "device/retract", "device/reset", CONTROLLER_START), Trigger),
    **dict.fromkeys(("device/enable", "device/confirm_needle_out"), SetBool),
}


@contextmanager
def ros(domain: int) -> Iterator[None]:
    """Initialize ROS in this process and a domain; shut it down at the end."""
    # Shared memory could delay the hold while another node starts.
    restrict_discovery(shared_memory=False)
    rclpy.init(args=[], domain_id=domain)
    try:
        yield
    finally:
        rclpy.try_shutdown()


class MotorPosition(NamedTuple):
    """Position of the motors with its source time stamp [s], [m], [rad]."""

    time: float
    insertion: float
    rotation: float


class RosRigClient(WholeNode):
    """A node whose callbacks run while a trial waits.

    Parameters
    ----------
    position_topic : str
        Topic (sensor_msgs/JointState) of the position.
    holds : bool
        Whether it publishes device/hold.

    Attributes
    ----------
    positions : list of MotorPosition
        Received positions.
    status, controller : dict of str to str
        Last status of device and controller.
    pressed : bool
        Whether the hold is pressed.
    """

    def __init__(self, position_topic: str = "joint_states", *, holds: bool = True) -> None:
        super().__init__("hand")
        self.positions: list[MotorPosition] = []
        self.status: dict[str, str] = {}
        self.controller: dict[str, str] = {}
        self.pressed = False
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        listen = self.create_subscription
        listen(JointState, position_topic, self._on_joints, JOINT_STATES)
        listen(DiagnosticStatus, "device/status", self._on_status, LATCHED)
        listen(
            DiagnosticStatus,
            "needle/controller_status",
            lambda message: self.controller.update(values_of(message)),
            LATCHED,
        )
        self._clients_of: dict[str, Any] = {
            name: self.create_client(kind, name) for name, kind in _SERVICES.items()
        }
        self._session, self._types = HoldSession(self.get_name(), math.inf), rclpy_types()
        if holds:
            self._hold = self.create_publisher(Joy, "device/hold", HOLD)
            self.create_timer(_HOLD_PERIOD, self.send_hold, clock=STEADY_CLOCK)

    # ---- waiting ------------------------------------------------------------------------------

    def spin(self, timeout: float = 0.0) -> None:
        """Run one callback, waiting for it at most `timeout` [s]."""
        self._executor.spin_once(timeout_sec=timeout)

    def until(self, condition: Callable[[], bool], what: str, timeout: float = TIMEOUT) -> None:
        """Wait for a condition.

        Raises
        ------
        UserError
            If the condition does not hold within `timeout` [s].
        """
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                status = f"device: {self.status}, controller: {self.controller.get('state')}"
                raise UserError(f"timed out after {timeout:g} s: {what}; {status}")
            self.spin(0.01)

    def pause(self, seconds: float) -> None:
        """Run callbacks for a duration [s]."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.spin(0.005)

    def close(self) -> None:
        """Destroy the node."""
        self._executor.shutdown()
        self.destroy_node()

    # ---- actions ------------------------------------------------------------------------------

    def call(self, name: str, data: bool | None = None) -> bool:
        """Call a service; return its `success`."""
        client = self._clients_of[name]
        self.until(client.service_is_ready, f"service {name}", 3.0 * TIMEOUT)
        request = Trigger.Request() if data is None else SetBool.Request(data=data)
        future = client.call_async(request)
        self.until(future.done, f"an answer from {name}")
        return bool(future.result().success)

    def call_until_success(self, name: str, data: bool | None = None) -> None:
        """Call a service until it succeeds; raises as `until`."""
        self.until(lambda: self.call(name, data), f"success of {name}")

    def prepare(self) -> None:
        """Confirm that the needle is out, home both axes and enable them; raises as `until`."""
        self.call_until_success("device/confirm_needle_out", True)
        self.call_until_success("device/home")
        off_at_home = {"homed": "true", "state": "DISABLED"}.items()
        self.until(lambda: off_at_home <= self.status.items(), "homed")
        self.call_until_success("device/enable", True)

    def send_hold(self) -> None:
        """Publish the hold."""
        message = self._session.next_message(time.time_ns(), pressed=self.pressed)
        self._hold.publish(to_ros(message, self._types))

    # ---- motion -------------------------------------------------------------------------------

    @property
    def insertion(self) -> float:
        """Present insertion [m]."""
        return self.positions[-1].insertion if self.positions else 0.0

    def last_motion(self, begin: float, end: float) -> float:
        """Return the time of the last motion in an interval [s]; its start if there was none."""
        return max((at.time for at, _ in self._motions(begin, end)), default=begin)

    def travelled_distance(self, begin: float, end: float = math.inf) -> float:
        """Return the distance travelled in an interval, in both directions [m]."""
        return sum(distance for _, distance in self._motions(begin, end))

    def _motions(self, begin: float, end: float) -> Iterator[tuple[MotorPosition, float]]:
        """Yield each changed position in an interval, and its distance from the one before."""
        for before, after in itertools.pairwise(self.positions):
            distance = abs(after.insertion - before.insertion)
            if begin < after.time <= end and distance > _STILL:
                yield after, distance

    def _on_joints(self, message: JointState, info: dict[str, int]) -> None:
        at = dict(zip(message.name, message.position, strict=True))
        sent = info["source_timestamp"] * 1e-9
        self.positions.append(MotorPosition(sent, at["insertion_joint"], at["rotation_joint"]))

    def _on_status(self, message: DiagnosticStatus) -> None:
        self.status = values_of(message)
