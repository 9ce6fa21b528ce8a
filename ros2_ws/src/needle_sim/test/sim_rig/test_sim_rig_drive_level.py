"""sim_rig at level drive, beside a scripted driver, drives, tracker and controller."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.context import Context
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import Bool, Header

from needle_core.errors import UserError
from needle_core.ros.conversions import (
    IMAGES,
    JOINT_STATES,
    LATCHED,
    RELIABLE,
    to_nanoseconds,
    to_stamp,
)
from own_context import own_context

from .bench import SimRigBench

TICK_NS = 20_000_000
WAY_PER_TICK = 4e-5


class Others(Node):
    """Everybody else: moves 0.04 mm a tick while it has a way to go, and lies about it."""

    def __init__(self, context: Context) -> None:
        super().__init__("others", context=context)
        self.position = 0.0
        self.target = 0.0
        self.silent = False
        self.ticks: list[int] = []
        self.truths: list[PoseStamped] = []
        self.stops: list[bool] = []
        self.warnings: list[str] = []
        self.pairs = 0
        publish = self.create_publisher
        self._status = publish(DiagnosticStatus, "device/status", LATCHED)
        self._controller = publish(DiagnosticStatus, "needle/controller_status", LATCHED)
        self._results = publish(Header, "device/result", RELIABLE)
        self._joints = publish(JointState, "joint_states", JOINT_STATES)
        self._positions = publish(JointState, "sim/drive_positions", JOINT_STATES)
        self._answers = publish(PoseWithCovarianceStamped, "needle/tip_pose", RELIABLE)
        listen = self.create_subscription
        listen(Clock, "/clock", self._on_clock, RELIABLE)
        listen(PoseStamped, "sim/tip_pose", self.truths.append, RELIABLE)
        listen(Bool, "device/estop", lambda message: self.stops.append(message.data), RELIABLE)
        listen(DiagnosticArray, "/diagnostics", self._on_diagnostics, RELIABLE)
        # Heard by the controller on a real rig.
        listen(JointState, "joint_states", lambda _: None, JOINT_STATES)
        listen(Header, "device/result", lambda _: None, RELIABLE)
        listen(DiagnosticStatus, "device/status", lambda _: None, LATCHED)
        sides: set[str] = set()

        def on_image(side: str, image: Image) -> None:
            sides.add(side)
            if len(sides) == 2:
                sides.clear()
                self.pairs += 1
                answer = PoseWithCovarianceStamped(header=image.header)
                answer.pose.covariance[0] = 1e-8
                self._answers.publish(answer)

        for side in ("left", "right"):
            listen(Image, f"stereo/{side}/image_raw", functools.partial(on_image, side), IMAGES)
            listen(CameraInfo, f"stereo/{side}/camera_info", lambda _: None, IMAGES)

    def say(self, publisher: Any, **values: str) -> None:
        pairs = [KeyValue(key=k, value=v) for k, v in values.items()]
        publisher.publish(DiagnosticStatus(level=b"\0", values=pairs))

    def steer(self, tip_after_ns: int) -> None:
        self.say(self._controller, state="STEERING", awaiting="tip", tip_after_ns=str(tip_after_ns))

    def device(self, state: str, activity: str = "none", *, needs_time: bool = False) -> None:
        owner = "others" if state in ("HOLDING", "MOVING") else ""
        self.say(
            self._status,
            state=state,
            activity=activity,
            hold_owner=owner,
            needs_time="true" if needs_time else "false",
        )

    def begin_step(self, length: float) -> None:
        self.target = self.position + length
        self.device("MOVING", "step", needs_time=True)

    def _on_clock(self, message: Clock) -> None:
        time_ns = to_nanoseconds(message.clock)
        if self.ticks and time_ns <= self.ticks[-1]:
            return
        self.ticks.append(time_ns)
        if self.silent:
            return
        before = self.position
        self.position = min(self.position + WAY_PER_TICK, self.target)
        moves = self.position != before
        joints = JointState(name=["insertion_joint", "rotation_joint"])
        joints.header.stamp = message.clock
        joints.velocity = [float(moves), 0.0]
        joints.position = [self.position, 0.0]
        self._positions.publish(joints)
        if before != self.target == self.position:
            self.device("HOLDING")
            self._results.publish(Header(stamp=to_stamp(1), frame_id="succeeded"))
        # A driver that believes in another place must not move the needle there.
        joints.position = [self.position + 1.0, 2.0]
        self._joints.publish(joints)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.warnings += [s.message for s in message.status if s.level != b"\0"]


class Rig(SimRigBench):
    def __init__(self, context: Context, **parameters: Any) -> None:
        super().__init__(context, level="drive", **parameters)
        self.others = Others(context)
        self.join(self.others)

    def heard(self) -> object:
        return self.others.warnings

    def look_around(self) -> None:
        for _ in range(100):
            self.look(0.002)

    def start(self) -> None:
        self.others.steer(0)
        self.look_around()
        # A driver that is not configured yet keeps time from starting.
        assert self.others.truths == []
        self.others.device("HOLDING")
        self.until(lambda: len(self.others.truths) == 1, "first exposure")
        self.until(lambda: self.others.pairs == 1, "first pair")
        self.others.say(
            self.others._controller, state="STEERING", awaiting="result", tip_after_ns="0"
        )
        self.look_around()


@contextmanager
def running(**parameters: Any) -> Iterator[Rig]:
    with own_context() as context:
        rig = Rig(context, **parameters)
        try:
            yield rig
        finally:
            rig.close()


def test_needle_is_moved_by_the_drives_in_step_with_the_driver() -> None:
    with running(curvature=0.0) as rig:
        rig.start()
        others = rig.others
        began = others.ticks[-1]
        for number in (2, 3):
            others.begin_step(0.001)
            rig.until(lambda n=number: len(others.truths) == n, "exposure")  # type: ignore[misc]
            rig.until(lambda n=number: others.pairs == n, "pair")  # type: ignore[misc]
        rig.look_around()
        at = [truth.pose.position.z for truth in others.truths]
        assert at == pytest.approx([0.0, 0.001, 0.002], abs=1e-12)
        # 25 ticks a step, one until the motor is known to stand, one for the exposure; then none.
        assert [(t - began) // TICK_NS for t in others.ticks if t > began] == list(range(1, 55))
        assert others.warnings == [] or all("waiting for" in w for w in others.warnings)


def test_a_device_that_is_real_ends_it() -> None:
    with running() as rig:
        rig.start()
        rig.others.say(rig.others._status, state="HOLDING", simulated="false")
        with pytest.raises(UserError, match="simulated = false"):
            rig.until(lambda: False, "its end")


def test_nothing_is_exposed_during_a_step_that_stands_still() -> None:
    with running() as rig:
        rig.start()
        others = rig.others
        others.target = 0.0
        others.device("MOVING", "step")
        others.steer(others.ticks[-1])
        rig.look_around()
        assert len(others.truths) == 1
        others.device("HOLDING")
        rig.until(lambda: len(others.truths) == 2, "exposure after the step")


def test_unanswered_tick_is_counted_and_time_goes_on() -> None:
    with running(tick_timeout=0.05) as rig:
        rig.start()
        others = rig.others
        ticks = len(others.ticks)
        others.silent = True
        others.begin_step(0.001)
        rig.until(lambda: len(others.ticks) >= ticks + 3, "ticks without answer")
        rig.until(lambda: any("unanswered for 0.05 s" in w for w in others.warnings), "warning")
        others.silent = False
        rig.until(lambda: len(others.truths) == 2, "exposure after the step")
        assert others.truths[1].pose.position.z == pytest.approx(0.001, abs=1e-5)


def test_a_tip_outside_the_phantom_presses_the_emergency_stop() -> None:
    with running(initial_pitch=math.pi / 2, curvature=0.0) as rig:
        rig.start()
        others = rig.others
        others.position = 0.0174
        others.begin_step(0.001)
        rig.until(lambda: others.stops == [True], "emergency stop")
        rig.until(lambda: any("left the phantom" in w for w in others.warnings), "reason")
