"""Operator and controller as a script, beside sim_rig at levels tip and camera."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PointStamped, PoseStamped, PoseWithCovarianceStamped
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image, JointState, Joy
from std_msgs.msg import Bool, Header
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from needle_core.ros.base_node import STEADY_CLOCK
from needle_core.ros.conversions import (
    HOLD,
    IMAGES,
    JOINT_STATES,
    LATCHED,
    RELIABLE,
    to_nanoseconds,
    to_stamp,
    values_of,
)
from own_context import own_context

from .bench import SimRigBench


class Partner(Node):
    """Plays operator and controller, and keeps what it hears."""

    def __init__(self, context: Context) -> None:
        super().__init__("partner", context=context)
        self.tips: list[PointStamped] = []
        self.joints: list[JointState] = []
        self.infos: list[CameraInfo] = []
        self.truths: list[PoseStamped] = []
        self.results: list[Header] = []
        self.status: dict[str, str] = {}
        self.pressed = False
        self.silent = False
        self.scale = 1.0
        self.rotation_per_step = 0.1
        self._commands = self.create_publisher(JointTrajectory, "device/joint_trajectory", RELIABLE)
        self._hold = self.create_publisher(Joy, "device/hold", HOLD)
        self._status = self.create_publisher(DiagnosticStatus, "needle/controller_status", LATCHED)
        self._estop = self.create_publisher(Bool, "device/estop", RELIABLE)
        self.create_subscription(PointStamped, "needle/tip", self.tips.append, RELIABLE)
        self.create_subscription(JointState, "joint_states", self.joints.append, JOINT_STATES)
        self._truth = self.create_subscription(
            PoseStamped, "sim/tip_pose", self.truths.append, RELIABLE
        )
        self.create_subscription(Header, "device/result", self.results.append, RELIABLE)
        self.create_subscription(DiagnosticStatus, "device/status", self._on_status, LATCHED)
        self._device_services: dict[str, Any] = {
            name: self.create_client(kind, f"device/{name}")
            for kind, names in (
                (Trigger, ("home", "retract", "stop", "reset")),
                (SetBool, ("enable", "confirm_needle_out")),
            )
            for name in names
        }
        self.create_timer(0.05, self.send_hold, clock=STEADY_CLOCK)

    def track(self) -> None:
        """Play the tracker too: answer every pair of images."""
        self.pairs: list[dict[str, Image]] = []
        self.found = True
        answers = self.create_publisher(PoseWithCovarianceStamped, "needle/tip_pose", RELIABLE)
        waiting: dict[str, Image] = {}

        def take(side: str, image: Image) -> None:
            waiting[side] = image
            if len(waiting) < 2:
                return
            self.pairs.append(dict(waiting))
            waiting.clear()
            answer = PoseWithCovarianceStamped(header=image.header)
            answer.pose.covariance[0] = 1e-8 if self.found else math.inf
            answers.publish(answer)

        for side in ("left", "right"):
            self.create_subscription(
                Image, f"stereo/{side}/image_raw", functools.partial(take, side), IMAGES
            )
            self.create_subscription(
                CameraInfo, f"stereo/{side}/camera_info", self.infos.append, IMAGES
            )

    def call(self, name: str, data: bool | None = None) -> Any:
        request = Trigger.Request() if data is None else SetBool.Request(data=data)
        return self._device_services[name].call_async(request)

    def ready(self) -> bool:
        return all(client.service_is_ready() for client in self._device_services.values())

    def hears_truth(self) -> bool:
        return bool(self._truth.get_publisher_count() > 0)

    def send_hold(self) -> None:
        if self.silent:
            return
        message = Joy(axes=[self.scale], buttons=[int(self.pressed)])
        message.header.frame_id = "partner"
        message.header.stamp = to_stamp(time.time_ns())
        self._hold.publish(message)

    def estop(self, pressed: bool) -> None:
        self._estop.publish(Bool(data=pressed))

    def say(self, state: str, awaiting: str, tip_after_ns: int) -> None:
        values = {"state": state, "awaiting": awaiting, "tip_after_ns": str(tip_after_ns)}
        self._status.publish(
            DiagnosticStatus(
                level=b"\0", values=[KeyValue(key=k, value=v) for k, v in values.items()]
            )
        )

    def command(self, insertion: float, rotation: float, stamp_ns: int) -> None:
        point = JointTrajectoryPoint(positions=[insertion, rotation])
        point.time_from_start.nanosec = 500_000_000
        message = JointTrajectory(joint_names=["insertion_joint", "rotation_joint"], points=[point])
        message.header.stamp = to_stamp(stamp_ns)
        self._commands.publish(message)

    def _on_status(self, message: DiagnosticStatus) -> None:
        self.status = values_of(message)


class Rig(SimRigBench):
    """A sim_rig and its partner on one executor."""

    def __init__(self, context: Context, **parameters: Any) -> None:
        self.level = parameters.setdefault("level", "tip")
        super().__init__(context, **parameters)
        self.partner = Partner(context)
        self.join(self.partner)
        if self.level == "camera":
            self.partner.track()

    def heard(self) -> object:
        return self.partner.status

    def until_tips(self, count: int) -> None:
        self.until(lambda: len(self.partner.tips) == count, f"{count} tips")

    def call(self, name: str, data: bool | None = None) -> Any:
        future = self.partner.call(name, data)
        self.until(future.done, name)
        return future.result()

    def prepare(self) -> None:
        partner = self.partner
        self.until(partner.ready, "services")
        self.until(partner.hears_truth, "truth")
        partner.say("IDLE", "nothing", 0)

        def started() -> bool:
            future = partner.call("confirm_needle_out", True)
            self.until(future.done, "confirm")
            return bool(future.result().success)

        self.until(started, "start of time")
        for name, data in (("home", None), ("enable", True)):
            answer = self.call(name, data)
            assert answer.success, answer.message
        self.until(lambda: partner.status.get("homed") == "true", "homed")
        # They are repeated until the first exposure, and may have been missed before.
        self.until(lambda: bool(partner.joints), "joints at the start of time")
        partner.pressed = True
        self.until(lambda: partner.status["hold_owner"] == "partner", "hold")
        partner.say("STEERING", "tip", 0)
        if self.level == "tip":
            self.until(lambda: len(partner.tips) > 0, "first tip")

    def step(self, length: float = 0.001) -> Header:
        partner = self.partner
        done = len(partner.results)
        # Topics have no order among each other: wait for the joints at the tip's exposure.
        tips = partner.tips if self.level == "tip" else partner.truths
        stamp = tips[-1].header.stamp
        self.until(
            lambda: bool(partner.joints) and partner.joints[-1].header.stamp == stamp,
            "joints at the tip's stamp",
        )
        last = partner.joints[-1]
        partner.command(
            last.position[0] + length,
            last.position[1] + partner.rotation_per_step,
            to_nanoseconds(stamp),
        )
        self.until(lambda: len(partner.results) > done, "result")
        return partner.results[-1]


@contextmanager
def running(**parameters: Any) -> Iterator[Rig]:
    with own_context() as context:
        rig = Rig(context, **parameters)
        try:
            yield rig
        finally:
            rig.close()
