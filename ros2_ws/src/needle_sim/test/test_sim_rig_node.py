"""sim_rig at level tip, beside a scripted operator and controller in the same process."""

from __future__ import annotations

import functools
import itertools
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import pytest
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PointStamped, PoseStamped, PoseWithCovarianceStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, Image, JointState, Joy
from std_msgs.msg import Bool, Header
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from needle_common.base_node import STEADY_CLOCK
from needle_common.conversions import (
    HOLD,
    IMAGES,
    JOINT_STATES,
    LATCHED,
    RELIABLE,
    to_nanoseconds,
    to_stamp,
    values_of,
)
from needle_common.errors import UserError
from needle_common.own_context_node import own_context
from needle_sim.sim_rig_node import SimRigNode

LIMIT = 20.0


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


class Rig:
    """A sim_rig and its partner on one executor."""

    def __init__(self, context: Context, **parameters: Any) -> None:
        overrides = {"level": "tip", **parameters}
        self.level = overrides["level"]
        self.sim = SimRigNode(
            context=context,
            parameter_overrides=[Parameter(k, value=v) for k, v in overrides.items()],
        )
        self.partner = Partner(context)
        if overrides["level"] == "camera":
            self.partner.track()
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.sim)
        self._executor.add_node(self.partner)

    def until(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < deadline, f"timed out: {what}; {self.partner.status}"
            self._executor.spin_once(timeout_sec=min(self.sim.turns(), 0.01))

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

    def close(self) -> None:
        self.sim.close()
        self._executor.shutdown()
        self.sim.destroy_node()
        self.partner.destroy_node()


@contextmanager
def running(**parameters: Any) -> Iterator[Rig]:
    with own_context() as context:
        rig = Rig(context, **parameters)
        try:
            yield rig
        finally:
            rig.close()


def five_steps(seed: int) -> tuple[list[Any], list[Any], list[Any]]:
    with running(seed=seed, initial_pitch=0.035, initial_roll=0.26) as rig:
        rig.prepare()
        partner = rig.partner
        for number in range(5):
            assert rig.step().frame_id == "succeeded"
            rig.until_tips(number + 2)
        rig.until(lambda: len(partner.truths) == 6, "truth")
        stamp = partner.tips[-1].header.stamp
        rig.until(lambda: partner.joints[-1].header.stamp == stamp, "joints")
        # Until the first exposure the joints at the start of time are repeated for late joiners.
        joints = [a for a, b in itertools.pairwise(partner.joints) if a != b]
        return partner.tips, [*joints, partner.joints[-1]], partner.truths


def test_five_steps_repeat_bit_for_bit_with_one_seed_and_differ_with_another() -> None:
    first, second, other = five_steps(1), five_steps(1), five_steps(2)
    assert first == second
    assert first[0] != other[0]
    # The disturbance is in the measurement only: commands were the same, so is the truth.
    assert first[2] == other[2]
    tips, joints, truths = first
    assert joints[-1].position == pytest.approx([0.005, 0.5])
    stamps = [to_nanoseconds(joint.header.stamp) for joint in joints]
    # One at the start of time, 25 in each step, one at each of six exposures: none was lost.
    assert [b - a for a, b in itertools.pairwise(stamps)] == [20_000_000] * 131
    for tip, truth in zip(tips, truths, strict=True):
        assert tip.header == truth.header
        assert tip.header.frame_id == "rig"
        assert abs(tip.point.x - truth.pose.position.x) <= 1e-3
    assert truths[-1].pose.position.z == pytest.approx(0.005, abs=1e-5)


def test_services_refuse_while_partners_are_missing_and_say_which() -> None:
    with own_context() as context:
        sim = SimRigNode(context=context, parameter_overrides=[Parameter("level", value="tip")])
        asker = Node("asker", context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(sim)
        executor.add_node(asker)
        client = asker.create_client(SetBool, "device/enable")
        deadline = time.monotonic() + LIMIT

        def until(condition: Callable[[], bool]) -> None:
            while not condition():
                assert time.monotonic() < deadline
                executor.spin_once(timeout_sec=sim.turns())

        def enable(on: bool) -> Any:
            future = client.call_async(SetBool.Request(data=on))
            until(future.done)
            return future.result()

        try:
            until(client.service_is_ready)
            answer = enable(True)
            assert not answer.success
            assert answer.message.startswith("waiting for ")
            assert "publisher of /device/hold" in answer.message
            assert "subscriber of /needle/tip" in answer.message
            # Whoever wants less motion is never kept waiting.
            assert enable(False).success
        finally:
            executor.shutdown()
            asker.destroy_node()
            sim.destroy_node()


def test_time_starts_only_with_the_recorder_where_one_is_wanted() -> None:
    with running(wait_for_recorder=True) as rig:
        rig.until(rig.partner.ready, "services")
        rig.partner.say("IDLE", "nothing", 0)

        def refusal() -> str:
            return str(rig.call("confirm_needle_out", True).message)

        rig.until(lambda: "recorder of" in refusal(), "only the recorder is missing")
        assert "recorder of /sim/tip_pose" in refusal()
        assert "recorder of /joint_states" in refusal()
        assert rig.partner.joints == []


def test_releasing_the_hold_aborts_the_step_and_the_next_tip_tells_where() -> None:
    with running() as rig:
        rig.prepare()
        partner = rig.partner
        # The step would never end: lock step stands still at speed 0.
        partner.scale = 0.0
        partner.send_hold()
        rig.until(lambda: partner.status["speed_scale"] == "0", "standing still")
        partner.command(0.001, 0.1, to_nanoseconds(partner.tips[-1].header.stamp))
        rig.until(lambda: partner.status["state"] == "MOVING", "step under way")
        partner.pressed = False
        rig.until(lambda: len(partner.results) == 1, "abort")
        assert partner.results[0].frame_id == "aborted: hold released"
        assert partner.results[0].stamp == partner.tips[0].header.stamp
        rig.until(lambda: len(partner.tips) == 2, "exposure after the abort")
        rig.until(lambda: partner.status["hold_owner"] == "", "no owner")


def test_a_lapsed_hold_pauses_and_is_counted() -> None:
    with running() as rig:
        rig.prepare()
        partner = rig.partner
        partner.silent = True
        rig.until(lambda: partner.status["reason"].endswith("paused"), "lapse")
        partner.command(0.001, 0.1, to_nanoseconds(partner.tips[-1].header.stamp))
        rig.until(lambda: partner.status["state"] == "MOVING", "step accepted")
        joints = len(partner.joints)
        partner.silent = False
        rig.until(lambda: len(partner.results) == 1, "step done")
        assert partner.results[0].frame_id == "succeeded"
        rig.until(lambda: len(partner.joints) >= joints + 25, "joints of the step")


def test_estop_stops_and_takes_reset_and_enable() -> None:
    with running() as rig:
        rig.prepare()
        partner = rig.partner
        partner.estop(True)
        rig.until(lambda: partner.status["state"] == "ESTOPPED", "emergency stop")
        assert not rig.call("reset").success
        partner.estop(False)
        partner.pressed = False

        def reset() -> bool:
            return bool(rig.call("reset").success)

        rig.until(reset, "reset")
        rig.until(lambda: partner.status["state"] == "DISABLED", "disabled")
        assert rig.call("enable", True).success


def test_a_second_publisher_of_commands_is_refused() -> None:
    with running() as rig:
        rig.prepare()
        partner = rig.partner
        other = partner.create_publisher(JointTrajectory, "device/joint_trajectory", RELIABLE)
        rig.until(lambda: other.get_subscription_count() == 1, "second publisher")
        assert "2 nodes publish commands" in rig.step().frame_id
        rig.until(lambda: partner.status["commands_refused"] == "1", "count")


def test_retraction_draws_the_needle_to_the_entry_point() -> None:
    with running() as rig:
        rig.prepare()
        partner = rig.partner
        for number in range(2):
            assert rig.step().frame_id == "succeeded"
            rig.until_tips(number + 2)
        assert rig.call("retract").success
        rig.until(lambda: partner.joints[-1].position[0] == 0.0, "retracted")
        assert partner.joints[-1].position[1] == pytest.approx(0.2)
        rig.until(lambda: partner.status["state"] == "HOLDING", "holding")


def test_real_time_exposes_by_rate_and_a_lapse_aborts() -> None:
    with running(real_time_factor=1.0, camera_rate=10.0) as rig:
        rig.prepare()
        partner = rig.partner
        rig.until(lambda: len(partner.tips) >= 5, "tips")
        stamps = [to_nanoseconds(tip.header.stamp) for tip in partner.tips]
        assert {b - a for a, b in itertools.pairwise(stamps)} == {100_000_000}
        partner.scale = 0.0
        partner.send_hold()
        rig.until(lambda: partner.status["speed_scale"] == "0", "standing still")
        partner.command(0.001, 0.0, to_nanoseconds(partner.tips[-1].header.stamp))
        rig.until(lambda: partner.status["state"] == "MOVING", "step under way")
        partner.silent = True
        rig.until(lambda: len(partner.results) == 1, "abort")
        assert partner.results[0].frame_id.startswith("aborted: no hold message for")
        rig.until(lambda: int(partner.status["watchdog_trips"]) >= 1, "count")


def test_camera_exposes_pairs_again_when_lost_and_ends_where_the_tip_leaves_the_phantom() -> None:
    # Almost straight up: out of the surface, 17.5 mm above, within ten steps.
    with running(level="camera", initial_pitch=1.4, curvature=0.0) as rig:
        rig.prepare()
        partner = rig.partner
        rig.until(lambda: len(partner.pairs) == 1, "first pair")
        left, right = partner.pairs[0]["left"], partner.pairs[0]["right"]
        assert left.header.stamp == right.header.stamp
        assert left.header.frame_id == "left_camera_optical"
        assert right.header.frame_id == "right_camera_optical"
        assert (left.encoding, left.step, len(left.data)) == ("mono8", 1024, 1024 * 768)
        assert bytes(left.data) != bytes(right.data)
        rig.until(lambda: len(partner.infos) == 2, "camera infos")
        assert all(info.header.stamp == left.header.stamp for info in partner.infos)

        partner.found = False
        partner.rotation_per_step = 0.0
        assert rig.step(0.002).frame_id == "succeeded"
        rig.until(lambda: len(partner.pairs) == 4, "exposures again while the tip is lost")
        partner.found = True

        outcome = "succeeded"
        for _ in range(12):
            pairs = len(partner.pairs)
            outcome = rig.step(0.002).frame_id
            if outcome != "succeeded":
                break
            rig.until(lambda n=pairs: len(partner.pairs) > n, "pair after the step")  # type: ignore[misc]
        assert outcome.startswith("aborted: the tip left the phantom: x = 17.5")
        rig.until(lambda: partner.status["state"] == "FAULT", "fault")
        assert partner.status["fault"] in outcome
        assert "the run has ended" in rig.call("reset").message


def test_what_it_renders_is_written_with_insertion_and_truth(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    with running(level="camera", scenario="clutter", seed=3, images=str(folder)) as rig:
        rig.prepare()
        partner = rig.partner
        rig.until(lambda: len(partner.pairs) == 1, "first pair")
        assert rig.step(0.002).frame_id == "succeeded"
        rig.until(lambda: len(partner.pairs) == 2, "pair after the step")
        sent, truth = partner.pairs, partner.truths[1].pose.position
    for number, pair in enumerate(sent):
        for side, image in pair.items():
            written = cv2.imread(str(folder / side / f"{number:06d}.png"), cv2.IMREAD_UNCHANGED)
            assert written is not None
            assert written.tobytes() == bytes(image.data)
    lines = (folder / "insertion.csv").read_text().splitlines()
    assert lines[:2] == ["name,insertion_m", "000000.png,0.0"]
    assert float(lines[2].split(",")[1]) == pytest.approx(0.002)
    lines = (folder / "truth.csv").read_text().splitlines()
    assert lines[1] == "000000.png,,,,,,,,0.0,0.0"
    assert [float(value) for value in lines[2].split(",")[1:4]] == [truth.x, truth.y, truth.z]
    assert (folder / "calibration.yaml").is_file()


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"scenario": "fog"}, "scenario = 'fog' is not one of clean"),
        ({"scenario": "clutter"}, "scenario = 'clutter': level tip has no images"),
        ({"images": "somewhere"}, "images = 'somewhere': level tip has no images"),
        ({"level": "camera", "images": "/dev/null/x"}, "cannot write /dev/null/x"),
        ({"level": "x"}, "level"),
        ({"curvature": -1.0}, "curvature"),
        ({"max_speed": 0.006}, "max_speed"),
        ({"speed": 1.0}, "unknown parameter 'speed'"),
        ({"level": "camera", "calibration_file": "/nowhere.yaml"}, "/nowhere.yaml"),
    ],
)
def test_bad_parameters_are_refused_in_one_line(parameters: dict[str, Any], message: str) -> None:
    with own_context() as context, pytest.raises(UserError, match=message):
        Rig(context, **parameters)
