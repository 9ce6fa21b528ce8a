"""The hand, the controller and the witness of a drive trial in one node."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from campaign.trials.holds.hold_topic import HoldTopic
from campaign.trials.listening_node import PATIENCE, ListeningNode
from needle_core.errors import UserError
from needle_core.message_types import NANOSECONDS
from needle_core.ros.base_node import STEADY_CLOCK
from needle_core.ros.conversions import (
    JOINT_STATES,
    LATCHED,
    RELIABLE,
    to_nanoseconds,
    to_stamp,
    values_of,
)

JOINTS = ("insertion_joint", "rotation_joint")
# What a count of the encoder is [m]: the emulator's default.
INSERTION_COUNT = 1.0 / 2.0e7
_HOLD_PERIOD = 0.05


@dataclasses.dataclass(frozen=True)
class Motors:
    """True places of the motors [m], [rad], at their time [ns]."""

    stamp_ns: int
    insertion: float
    rotation: float


class DriveHand(ListeningNode):
    """Presses the hold, sends steps, calls services; hears what came of it.

    Parameters
    ----------
    steers : bool
        Whether it sends steps: a second sender of commands would have all of them refused.
    """

    def __init__(self, *, steers: bool = True) -> None:
        super().__init__("drive_hand")
        self.motors: list[Motors] = []
        self.joints: JointState | None = None
        self.joint_stamps: list[int] = []
        self.results: dict[int, str] = {}
        self.status: dict[str, str] = {}
        self.real_states: set[str] = set()
        self.pressed = False
        # What commands are stamped with.
        self.now_ns: Callable[[], int] = lambda: self.get_clock().now().nanoseconds
        self._last_stamp = 0
        self._commands = (
            self.create_publisher(JointTrajectory, "device/joint_trajectory", RELIABLE)
            if steers
            else None
        )
        self._hold = HoldTopic(self, self.get_name())
        listen = self.create_subscription
        self._joint_states = listen(JointState, "joint_states", self._on_joints, JOINT_STATES)
        listen(JointState, "sim/drive_positions", self._on_positions, JOINT_STATES)
        listen(Header, "device/result", self._on_result, RELIABLE)
        listen(DiagnosticStatus, "device/status", self._on_status, LATCHED)
        self._device: dict[str, Any] = {
            name: self.create_client(kind, f"device/{name}")
            for kind, names in (
                (Trigger, ("home", "retract", "stop", "reset")),
                (SetBool, ("enable", "confirm_needle_out")),
            )
            for name in names
        }
        self.create_timer(_HOLD_PERIOD, self.send_hold, clock=STEADY_CLOCK)

    def state_now(self) -> str:
        """Return what the device said last."""
        return f"; device: {self.status}"

    # ---- acting -------------------------------------------------------------------------------

    def ready(self) -> bool:
        """Return whether the driver is there."""
        return (
            all(client.service_is_ready() for client in self._device.values())
            and (self._commands is None or self._commands.get_subscription_count() > 0)
            and self._joint_states.get_publisher_count() > 0
        )

    def call(self, name: str, data: bool | None = None) -> tuple[bool, str]:
        """Call a service of the device; return its answer."""
        request = Trigger.Request() if data is None else SetBool.Request(data=data)
        answer = self.answer_to(self._device[name], request)
        return bool(answer.success), str(answer.message)

    def insist(self, name: str, data: bool | None = None) -> None:
        """Call a service until it succeeds.

        Raises
        ------
        UserError
            If it does not within 20 s.
        """
        deadline = time.monotonic() + PATIENCE
        while True:
            success, message = self.call(name, data)
            if success:
                return
            if time.monotonic() > deadline:
                fault = self.status.get("fault", "")
                raise UserError(f"device/{name} refused for {PATIENCE:g} s: {message} ({fault})")
            self.pause(0.05)

    def home(self) -> None:
        """Home both axes, the needle being out; not enabled afterwards."""
        self.insist("confirm_needle_out", True)
        self.insist("home")
        self.until(
            lambda: self.status.get("homed") == "true" and self.status.get("state") == "DISABLED",
            "homed",
        )

    def command(self, insertion: float, rotation: float, duration: float) -> int:
        """Send a step to these joints [m], [rad] in `duration` [s]; return its stamp."""
        stamp = max(self.now_ns(), self._last_stamp + 1)
        self._last_stamp = stamp
        point = JointTrajectoryPoint(positions=[insertion, rotation])
        whole = math.floor(duration)
        point.time_from_start.sec = whole
        point.time_from_start.nanosec = round((duration - whole) * NANOSECONDS)
        message = JointTrajectory(joint_names=list(JOINTS), points=[point])
        message.header.stamp = to_stamp(stamp)
        assert self._commands is not None
        self._commands.publish(message)
        return stamp

    def press(self) -> None:
        """Press the hold anew, and wait until it counts."""
        self.release()
        self.pressed = True
        self.until(lambda: self.status.get("hold_owner") == self.get_name(), "the hold counts")

    def release(self) -> None:
        """Release the hold, and wait until that is known."""
        self.pressed = False
        self.send_hold()
        self.until(lambda: self.status.get("hold_owner", "") == "", "the hold is off")

    def send_hold(self) -> None:
        """Say what the hold is."""
        self._hold.publish(pressed=self.pressed, speed=1.0)

    # ---- hearing ------------------------------------------------------------------------------

    def _on_joints(self, message: JointState) -> None:
        self.joints = message
        self.joint_stamps.append(to_nanoseconds(message.header.stamp))

    def _on_positions(self, message: JointState) -> None:
        at = dict(zip(message.name, message.position, strict=True))
        stamp_ns = to_nanoseconds(message.header.stamp)
        self.motors.append(Motors(stamp_ns, at[JOINTS[0]], at[JOINTS[1]]))

    def _on_result(self, message: Header) -> None:
        self.results[to_nanoseconds(message.stamp)] = message.frame_id

    def _on_status(self, message: DiagnosticStatus) -> None:
        self.status = values_of(message)
        if self.status.get("simulated") == "false":
            self.real_states.add(self.status.get("state", ""))
