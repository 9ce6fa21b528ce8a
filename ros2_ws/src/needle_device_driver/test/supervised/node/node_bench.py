"""device_driver on scripted drives behind python-can's virtual bus, in real time."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable
from typing import Any

import can
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState, Joy
from std_msgs.msg import Bool, Header
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from needle_core.can_frame import CAN
from needle_core.ros.component_node import ComponentNode
from needle_core.ros.conversions import (
    HOLD,
    JOINT_STATES,
    LATCHED,
    RELIABLE,
    to_stamp,
    values_of,
)
from needle_device_driver.link.can_port import CanPort
from needle_device_driver.parameters import DeviceDriverParameters
from needle_device_driver.procedure import Procedure
from needle_device_driver.ros.device_driver import make_driver

from ..scripted_drives import ScriptedDrive

LIMIT = 20.0
CHANNELS = itertools.count()
JOINTS = ["insertion_joint", "rotation_joint"]


def emulated_as(emulated: bool) -> Callable[..., Procedure[bool]]:
    """Return what takes the place of `are_emulated`."""

    def answer(_link: Any, _nodes: Any) -> Procedure[bool]:
        yield from ()
        return emulated

    return answer


class Peer:
    """Two scripted drives on the far end of a virtual bus."""

    def __init__(self, channel: str) -> None:
        self.drives = [ScriptedDrive(1), ScriptedDrive(2)]
        self.syncs = 0
        self._bus = can.Bus(interface="virtual", channel=channel)
        self._ended = False
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        beat_at = 0.0
        while not self._ended:
            message = self._bus.recv(0.02)
            beat, now = beat_at <= time.monotonic(), time.monotonic()
            if beat:
                beat_at = now + 0.02
            self.syncs += message is not None and message.arbitration_id == 0x80
            for drive in self.drives:
                if beat:
                    drive.say(0x700, bytes([drive.nmt]))
                if message is not None:
                    drive.take(message.arbitration_id, bytes(message.data))
                for cob_id, data in drive.out:
                    self._bus.send(
                        can.Message(arbitration_id=cob_id, data=data, is_extended_id=False)
                    )
                drive.out.clear()

    def close(self) -> None:
        self._ended = True
        self._thread.join()
        self._bus.shutdown()


class Partner(Node):
    """Plays operator and controller, and keeps what it hears."""

    def __init__(self, context: Context) -> None:
        super().__init__("partner", context=context)
        self.joints: list[JointState] = []
        self.results: list[Header] = []
        self.status: dict[str, str] = {}
        self.refused: dict[str, int] = {}
        self.commands = self.create_publisher(JointTrajectory, "device/joint_trajectory", RELIABLE)
        self.holds = self.create_publisher(Joy, "device/hold", HOLD)
        self.estops = self.create_publisher(Bool, "device/estop", RELIABLE)
        self.create_subscription(JointState, "joint_states", self.joints.append, JOINT_STATES)
        self.create_subscription(Header, "device/result", self.results.append, RELIABLE)
        self.create_subscription(DiagnosticStatus, "device/status", self._on_status, LATCHED)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, RELIABLE)
        self.device: dict[str, Any] = {
            name: self.create_client(kind, f"device/{name}")
            for kind, names in (
                (Trigger, ("home", "retract", "stop", "reset")),
                (SetBool, ("enable", "confirm_needle_out")),
            )
            for name in names
        }

    def _on_status(self, message: DiagnosticStatus) -> None:
        self.status = values_of(message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == "device_driver: input":
                self.refused = {
                    key.removeprefix("refused "): int(value)
                    for key, value in values_of(status).items()
                    if key.startswith("refused ")
                }


class Rig:
    """Driver, drives and partner on one executor."""

    def __init__(self, context: Context, **parameters: Any) -> None:
        channel = f"node-{next(CHANNELS)}"
        self.peer = Peer(channel)
        overrides = {
            "link": "virtual",
            "channel": channel,
            # A machine under load is no reason to stop.
            "reply_age_limit": 0.5,
            "hold_timeout": 0.5,
            **parameters,
        }
        self.driver = ComponentNode(
            "device_driver",
            DeviceDriverParameters,
            make_driver,
            lambda settings: {CAN: CanPort(settings.link_settings)},
            context=context,
            parameter_overrides=[Parameter(k, value=v) for k, v in overrides.items()],
        )
        self.partner = Partner(context)
        self.stamps = itertools.count(1)
        self.holding = False
        self._held_at = 0.0
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.driver)
        self._executor.add_node(self.partner)

    def until(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + LIMIT
        while not condition():
            now = time.monotonic()
            assert now < deadline, f"timed out: {what}; {self.partner.status}"
            if self.holding and now > self._held_at + 0.05:
                self.hold()
            self._executor.spin_once(timeout_sec=0.01)

    def matched(self) -> None:
        self.until(lambda: all(c.service_is_ready() for c in self.partner.device.values()), "?")
        self.until(
            lambda: (
                all(
                    publisher.get_subscription_count() > 0
                    for publisher in (
                        self.partner.commands,
                        self.partner.holds,
                        self.partner.estops,
                    )
                )
                and self.partner.count_publishers("joint_states") > 0
            ),
            "endpoints",
        )

    def hold(self, pressed: bool = True) -> None:
        self.holding = pressed
        self._held_at = time.monotonic()
        message = Joy(axes=[1.0], buttons=[int(pressed)])
        message.header.frame_id = "partner"
        message.header.stamp = to_stamp(next(self.stamps))
        self.partner.holds.publish(message)

    def until_refused(self, count: int) -> None:
        self.until(lambda: self.partner.status["commands_refused"] == str(count), "counted")

    def until_answered(self, before: int) -> None:
        self.until(lambda: len(self.partner.results) > before, "an answer")

    def call(self, name: str, data: bool | None = None) -> Any:
        request = Trigger.Request() if data is None else SetBool.Request(data=data)
        future = self.partner.device[name].call_async(request)
        self.until(future.done, name)
        return future.result()

    def insist(self, name: str, data: bool | None = None) -> None:
        """Call a service until it agrees: it refuses while the axes switch off."""
        while not self.call(name, data).success:
            # Calls without a break would keep the port's thread from running.
            self.cycles(5)

    def cycles(self, count: int) -> None:
        """Let so many cycles go by."""
        heard = len(self.partner.joints)
        self.until(lambda: len(self.partner.joints) > heard + count, "cycles")

    def ready(self) -> None:
        self.matched()
        self.until(lambda: self.partner.status.get("state") == "DISABLED", "configured")
        self.insist("confirm_needle_out", True)
        self.insist("home")
        self.until(lambda: self.partner.status["homed"] == "true", "homed")
        self.insist("enable", True)
        self.until(lambda: all(drive.state == "enabled" for drive in self.peer.drives), "power")
        self.cycles(5)
        self.hold(False)
        self.hold(True)
        self.until(lambda: self.partner.status["hold_owner"] == "partner", "hold")

    def message(
        self,
        positions: list[float] | None = None,
        *,
        names: list[str] = JOINTS,
        points: int = 1,
        stamp_ns: int | None = None,
        duration: float = 0.2,
    ) -> JointTrajectory:
        at = self.partner.joints[-1].position
        wanted = [at[0] + 0.001, at[1] + 0.1] if positions is None else positions
        point = JointTrajectoryPoint(positions=wanted)
        point.time_from_start.nanosec = round(duration * 1e9)
        message = JointTrajectory(joint_names=names, points=[point] * points)
        message.header.stamp = to_stamp(time.time_ns() if stamp_ns is None else stamp_ns)
        return message

    def send(self, message: JointTrajectory) -> Header:
        """Send a command and return what was answered."""
        before = len(self.partner.results)
        self.partner.commands.publish(message)
        self.until(lambda: len(self.partner.results) > before, "the step's end")
        return self.partner.results[-1]

    @property
    def positions(self) -> list[int]:
        return [drive.position for drive in self.peer.drives]

    def close(self) -> None:
        self.driver.close()
        self._executor.shutdown()
        self.driver.destroy_node()
        self.partner.destroy_node()
        self.peer.close()


Make = Callable[..., Rig]
