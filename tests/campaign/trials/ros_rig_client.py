"""A node in the place of a person: calls services, holds, and sees where the needle goes."""

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

from needle_core.convert import Converter
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

PATIENCE = 20.0
CONTROLLER_START = "plane_controller/start"
_HOLD_PERIOD = 0.05
# What counts as motion: less than any set-point, more than rounding [m].
_STILL = 1e-9
_SERVICES = {
    **dict.fromkeys(("device/home", "device/retract", "device/reset", CONTROLLER_START), Trigger),
    **dict.fromkeys(("device/enable", "device/confirm_needle_out"), SetBool),
}


@contextmanager
def ros(domain: int) -> Iterator[None]:
    """Start ROS in this process and in this domain, and shut it down in the end."""
    # Its hold must not lapse where a node appears.
    restrict_discovery(shared_memory=False)
    rclpy.init(args=[], domain_id=domain)
    try:
        yield
    finally:
        rclpy.try_shutdown()


class MotorPosition(NamedTuple):
    """MotorPosition of the motors at the system time at which it was said [s], [m], [rad]."""

    time: float
    insertion: float
    rotation: float


class RosRigClient(WholeNode):
    """A node whose callbacks run where a trial waits for something.

    Parameters
    ----------
    places_from : str
        Topic (sensor_msgs/JointState) that says where the needle is.
    holds : bool
        Whether it says something on device/hold.

    Attributes
    ----------
    places : list of MotorPosition
        As they were said.
    status, controller : dict of str to str
        What device and controller said last.
    pressed : bool
        Whether it presses.
    """

    def __init__(self, places_from: str = "joint_states", *, holds: bool = True) -> None:
        super().__init__("hand")
        self.places: list[MotorPosition] = []
        self.status: dict[str, str] = {}
        self.controller: dict[str, str] = {}
        self.pressed = False
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        listen = self.create_subscription
        listen(JointState, places_from, self._on_places, JOINT_STATES)
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
        self._session, self._converter = (
            HoldSession(self.get_name(), math.inf),
            Converter(rclpy_types()),
        )
        if holds:
            self._hold = self.create_publisher(Joy, "device/hold", HOLD)
            self.create_timer(_HOLD_PERIOD, self.send_hold, clock=STEADY_CLOCK)

    # ---- waiting ------------------------------------------------------------------------------

    def spin(self, timeout: float = 0.0) -> None:
        """Take one message, waiting for it at most `timeout` [s]."""
        self._executor.spin_once(timeout_sec=timeout)

    def until(self, condition: Callable[[], bool], what: str, patience: float = PATIENCE) -> None:
        """Wait for a condition.

        Raises
        ------
        UserError
            If it does not come within `patience` [s].
        """
        deadline = time.monotonic() + patience
        while not condition():
            if time.monotonic() > deadline:
                told = f"device: {self.status}, controller: {self.controller.get('state')}"
                raise UserError(f"waited {patience:g} s in vain: {what}; {told}")
            self.spin(0.01)

    def pause(self, seconds: float) -> None:
        """Listen for so long."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.spin(0.005)

    def close(self) -> None:
        """Let go of everything."""
        self._executor.shutdown()
        self.destroy_node()

    # ---- acting -------------------------------------------------------------------------------

    def call(self, name: str, data: bool | None = None) -> bool:
        """Call a service; return whether it agrees."""
        client = self._clients_of[name]
        self.until(client.service_is_ready, f"service {name}", 3.0 * PATIENCE)
        request = Trigger.Request() if data is None else SetBool.Request(data=data)
        future = client.call_async(request)
        self.until(future.done, f"an answer from {name}")
        return bool(future.result().success)

    def call_until_success(self, name: str, data: bool | None = None) -> None:
        """Call a service until it agrees; raises as `until`."""
        self.until(lambda: self.call(name, data), f"{name} agrees")

    def prepare(self) -> None:
        """Home both axes, the needle being out, and enable them; raises as `until`."""
        self.call_until_success("device/confirm_needle_out", True)
        self.call_until_success("device/home")
        off_at_home = {"homed": "true", "state": "DISABLED"}.items()
        self.until(lambda: off_at_home <= self.status.items(), "homed")
        self.call_until_success("device/enable", True)

    def send_hold(self) -> None:
        """Say what the hold is."""
        message = self._session.next_message(time.time_ns(), pressed=self.pressed)
        self._hold.publish(self._converter.to_ros(message))

    # ---- seeing -------------------------------------------------------------------------------

    @property
    def insertion(self) -> float:
        """The needle's insertion now [m]."""
        return self.places[-1].insertion if self.places else 0.0

    def last_motion(self, begin: float, end: float) -> float:
        """Return when the needle moved last of a time [s]; its beginning where it did not."""
        return max((at.time for at, _ in self._motions(begin, end)), default=begin)

    def travelled_distance(self, begin: float, end: float = math.inf) -> float:
        """Return how far the needle moved in a time, to and fro [m]."""
        return sum(way for _, way in self._motions(begin, end))

    def _motions(self, begin: float, end: float) -> Iterator[tuple[MotorPosition, float]]:
        """Yield each place of a time that is another than that before, and how far from it."""
        for before, after in itertools.pairwise(self.places):
            way = abs(after.insertion - before.insertion)
            if begin < after.time <= end and way > _STILL:
                yield after, way

    def _on_places(self, message: JointState, info: dict[str, int]) -> None:
        at = dict(zip(message.name, message.position, strict=True))
        sent = info["source_timestamp"] * 1e-9
        self.places.append(MotorPosition(sent, at["insertion_joint"], at["rotation_joint"]))

    def _on_status(self, message: DiagnosticStatus) -> None:
        self.status = values_of(message)
