"""device_driver on scripted drives behind python-can's virtual bus, with a clock of the test's."""

from __future__ import annotations

import itertools
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import can
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, Joy
from std_msgs.msg import Bool, Header
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from needle_common.conversions import (
    HOLD,
    JOINT_STATES,
    LATCHED,
    RELIABLE,
    to_nanoseconds,
    to_stamp,
    values_of,
)
from needle_common.errors import UserError
from needle_common.own_context_node import own_context
from needle_common.ros_domain import own_domain
from needle_device_driver.device_driver_node import DeviceDriverNode

LIMIT = 20.0
CHANNELS = itertools.count()
JOINTS = ["insertion_joint", "rotation_joint"]


class Peer:
    """Two scripted drives on the far end of a virtual bus."""

    def __init__(self, channel: str, drive: Any) -> None:
        self.drives = [drive(1), drive(2)]
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
    """Plays clock, operator and controller, and keeps what it hears."""

    def __init__(self, context: Context) -> None:
        super().__init__("partner", context=context)
        self.joints: list[JointState] = []
        self.results: list[Header] = []
        self.status: dict[str, str] = {}
        self.clock = self.create_publisher(Clock, "/clock", RELIABLE)
        self.commands = self.create_publisher(JointTrajectory, "device/joint_trajectory", RELIABLE)
        self.holds = self.create_publisher(Joy, "device/hold", HOLD)
        self.estops = self.create_publisher(Bool, "device/estop", RELIABLE)
        self.create_subscription(JointState, "joint_states", self.joints.append, JOINT_STATES)
        self.create_subscription(Header, "device/result", self.results.append, RELIABLE)
        self.create_subscription(DiagnosticStatus, "device/status", self._on_status, LATCHED)
        self.device: dict[str, Any] = {
            name: self.create_client(kind, f"device/{name}")
            for kind, names in (
                (Trigger, ("home", "retract", "stop", "reset")),
                (SetBool, ("enable", "confirm_needle_out")),
            )
            for name in names
        }
        self.change = self.create_client(ChangeState, "device_driver/change_state")
        self.get = self.create_client(GetState, "device_driver/get_state")

    def _on_status(self, message: DiagnosticStatus) -> None:
        self.status = values_of(message)


class Rig:
    """Driver, drives and partner on one executor; time is what the test says."""

    def __init__(self, context: Context, drive: Any, **parameters: Any) -> None:
        channel = f"node-{next(CHANNELS)}"
        self.peer = Peer(channel, drive)
        overrides = {
            "link": "virtual",
            "channel": channel,
            "use_sim_time": True,
            # A machine under load is no reason to stop.
            "reply_age_limit": 0.5,
            "hold_timeout": 0.5,
            **parameters,
        }
        self.driver = DeviceDriverNode(
            context=context,
            parameter_overrides=[Parameter(k, value=v) for k, v in overrides.items()],
        )
        self.partner = Partner(context)
        self.time_ns = 1_000_000_000
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
                        self.partner.clock,
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

    def tell_time(self) -> None:
        self.partner.clock.publish(Clock(clock=to_stamp(self.time_ns)))

    def tick(self, count: int = 1) -> None:
        """Let 20 ms go by, `count` times, each when the driver is through with the last."""
        for _ in range(count):
            self.time_ns += 20_000_000
            if self.holding:
                self.hold()
            self.tell_time()
            self.until(
                lambda: (
                    bool(self.partner.joints)
                    and to_nanoseconds(self.partner.joints[-1].header.stamp) == self.time_ns
                ),
                "joints of this tick",
            )

    def until_refused(self, count: int) -> None:
        self.until(lambda: self.partner.status["commands_refused"] == str(count), "counted")

    def until_answered(self, before: int) -> None:
        self.until(lambda: len(self.partner.results) > before, "an answer")

    def tick_until(self, condition: Callable[[], bool], what: str, most: int = 200) -> None:
        for _ in range(most):
            if condition():
                return
            self.tick()
        raise AssertionError(f"not within {most} ticks: {what}; {self.partner.status}")

    def call(self, name: str, data: bool | None = None) -> Any:
        request = Trigger.Request() if data is None else SetBool.Request(data=data)
        future = self.partner.device[name].call_async(request)
        self.until(future.done, name)
        return future.result()

    def transition(self, number: int) -> bool:
        future = self.partner.change.call_async(
            ChangeState.Request(transition=Transition(id=number))
        )
        self.until(future.done, "transition")
        return bool(future.result().success)

    @property
    def label(self) -> str:
        future = self.partner.get.call_async(GetState.Request())
        self.until(future.done, "state")
        return str(future.result().current_state.label)

    def ready(self) -> None:
        self.matched()
        self.until(lambda: self.partner.status.get("state") == "DISABLED", "configured")
        self.tick(2)
        assert self.call("confirm_needle_out", True).success
        answer = self.call("home")
        assert answer.success, answer.message
        self.tick_until(lambda: self.partner.status["homed"] == "true", "homed")
        self.tick_until(lambda: self.partner.status["needs_time"] == "false", "off")
        answer = self.call("enable", True)
        assert answer.success, answer.message
        self.tick_until(lambda: self.partner.status["needs_time"] == "false", "on")
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
        message.header.stamp = to_stamp(self.time_ns if stamp_ns is None else stamp_ns)
        return message

    def send(self, message: JointTrajectory) -> Header:
        """Send a command and return what was answered, time going by as long as it takes."""
        before = len(self.partner.results)
        self.partner.commands.publish(message)
        self.until(
            lambda: self.partner.status["state"] == "MOVING" or len(self.partner.results) > before,
            "an answer",
        )
        self.tick_until(lambda: len(self.partner.results) > before, "the step's end")
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


@pytest.fixture
def make_rig(scripted_drive: Any) -> Iterator[Callable[..., Rig]]:
    with own_context() as context:
        rigs: list[Rig] = []

        def make(**parameters: Any) -> Rig:
            rigs.append(Rig(context, scripted_drive, **parameters))
            return rigs[-1]

        yield make
        for rig in rigs:
            rig.close()


Make = Callable[..., Rig]


def test_steps_end_where_they_should_and_each_tick_is_one_sync(make_rig: Make) -> None:
    rig = make_rig(lock_step=True)
    rig.ready()
    syncs, joints = rig.peer.syncs, len(rig.partner.joints)
    message = rig.message()
    assert rig.send(message).frame_id == "succeeded"
    assert rig.partner.results[-1].stamp == message.header.stamp
    assert rig.positions == [20_000, round(0.1 * 65536 / (2 * math.pi))]
    assert rig.peer.syncs - syncs == len(rig.partner.joints) - joints
    rig.tick(3)
    # Time stands still: its repetition repeats the joints and moves nothing on.
    syncs, joints = rig.peer.syncs, len(rig.partner.joints)
    rig.tell_time()
    rig.until(lambda: len(rig.partner.joints) > joints, "repeated joints")
    assert rig.peer.syncs == syncs
    assert list(rig.partner.joints[-1].position) == list(rig.partner.joints[-2].position)


def test_bad_commands_are_refused_whole_and_disturb_nothing(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    assert rig.send(rig.message()).frame_id == "succeeded"
    rig.tick(2)
    at = rig.positions
    here = list(rig.partner.joints[-1].position)
    bad: dict[str, JointTrajectory] = {
        "not finite": rig.message([math.nan, 0.0]),
        "infinite": rig.message([math.inf, 0.0]),
        "not newer": rig.message(stamp_ns=rig.time_ns - 10_000_000_000),
        "future": rig.message(stamp_ns=rig.time_ns + 5_000_000_000),
        "wanted insertion_joint": rig.message(names=["insertion_joint", "roll_joint"]),
        "2 points": rig.message(points=2),
        "0 points": rig.message(points=0),
        "positions": rig.message([0.001]),
        "step 3 mm": rig.message([here[0] + 0.003, here[1]]),
        # Millimetres for metres, degrees for radians.
        "depth 2000 mm": rig.message([2.0, here[1]]),
        "not ahead": rig.message([here[0] - 0.001, here[1]]),
        "rotation 57.2": rig.message([here[0] + 0.001, here[1] + math.degrees(1.0)]),
        "speed": rig.message(duration=0.01),
        "time_from_start": rig.message(duration=0.0),
    }
    for number, (text, message) in enumerate(bad.items(), start=1):
        outcome = rig.send(message).frame_id
        assert outcome.startswith("aborted: "), text
        if text != "infinite":
            assert text in outcome
        assert rig.positions == at
        rig.until_refused(number)
    # In the middle of a step, too.
    rig.tick()
    good = rig.message()
    rig.partner.commands.publish(good)
    rig.until(lambda: rig.partner.status["state"] == "MOVING", "step")
    rig.tick(3)
    for message in (rig.message([math.nan, 0.0], stamp_ns=rig.time_ns), rig.message(points=3)):
        before = len(rig.partner.results)
        rig.partner.commands.publish(message)
        rig.until_answered(before)
        assert rig.partner.results[-1].frame_id.startswith("aborted: ")
    rig.tick_until(lambda: rig.partner.status["state"] == "HOLDING", "end")
    assert [r.frame_id for r in rig.partner.results if r.stamp == good.header.stamp][-1] == (
        "succeeded"
    )
    assert rig.positions[0] == at[0] + 20_000


def test_a_second_publisher_of_commands_moves_nothing(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    second = rig.partner.create_publisher(JointTrajectory, "device/joint_trajectory", RELIABLE)
    rig.until(lambda: rig.driver.count_publishers("device/joint_trajectory") == 2, "second")
    outcome = rig.send(rig.message()).frame_id
    assert "2 nodes publish commands" in outcome
    rig.partner.destroy_publisher(second)
    rig.until(lambda: rig.driver.count_publishers("device/joint_trajectory") == 1, "one again")
    rig.tick()
    assert rig.send(rig.message()).frame_id == "succeeded"


def test_the_emergency_stop_stops_both_drives_and_its_reset_moves_nothing(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    rig.partner.commands.publish(rig.message(duration=1.0))
    rig.until(lambda: rig.partner.status["state"] == "MOVING", "step")
    rig.tick(5)
    rig.partner.estops.publish(Bool(data=True))
    rig.until(lambda: rig.partner.status["state"] == "ESTOPPED", "emergency stop")
    rig.until(
        lambda: [drive.state for drive in rig.peer.drives] == ["quick stop"] * 2, "quick stops"
    )
    at = rig.positions
    rig.tick(3)
    assert not rig.call("reset").success
    rig.partner.estops.publish(Bool(data=False))
    rig.hold(False)
    rig.until(lambda: bool(rig.call("reset").success), "reset")
    rig.tick(10)
    assert rig.partner.status["state"] == "DISABLED"
    assert [drive.state for drive in rig.peer.drives] == ["disabled"] * 2
    assert rig.positions == at


def test_the_lifecycle_ends_in_switched_off_drives_and_begins_again(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    assert rig.label == "active"
    # A transition that this state does not have ends nothing.
    assert not rig.transition(Transition.TRANSITION_CONFIGURE)
    assert rig.label == "active"
    rig.partner.commands.publish(rig.message(duration=1.0))
    rig.until(lambda: rig.partner.status["state"] == "MOVING", "step")
    rig.tick(3)
    assert rig.transition(Transition.TRANSITION_DEACTIVATE)
    rig.until(lambda: rig.partner.status["state"] == "DISABLED", "disabled")
    rig.tick_until(
        lambda: [drive.state for drive in rig.peer.drives] == ["disabled"] * 2, "switched off"
    )
    assert "activated" in rig.call("enable", True).message
    assert rig.transition(Transition.TRANSITION_CLEANUP)
    rig.until(lambda: rig.partner.status["state"] == "UNCONFIGURED", "unconfigured")
    assert all(drive.objects[0x1016, 1] == bytes(4) for drive in rig.peer.drives)
    assert rig.transition(Transition.TRANSITION_CONFIGURE)
    assert rig.transition(Transition.TRANSITION_ACTIVATE)
    rig.until(lambda: rig.partner.status["state"] == "DISABLED", "configured again")
    assert rig.partner.status["homed"] == "false"
    assert rig.transition(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert rig.driver.ended


def test_its_end_in_the_middle_of_a_step_leaves_the_drives_off(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    message = rig.message(duration=1.0)
    rig.partner.commands.publish(message)
    rig.until(lambda: rig.partner.status["state"] == "MOVING", "step")
    rig.tick(5)
    rig.driver.close()
    at = rig.positions
    assert [drive.state for drive in rig.peer.drives] == ["disabled"] * 2
    assert all(drive.objects[0x1016, 1] == bytes(4) for drive in rig.peer.drives)
    rig.until(lambda: bool(rig.partner.results), "result")
    assert rig.partner.results[-1].stamp == message.header.stamp
    assert rig.partner.results[-1].frame_id.startswith("aborted: ")
    assert rig.positions == at


def test_without_autostart_nothing_is_configured_until_it_is_asked_for(make_rig: Make) -> None:
    rig = make_rig(autostart=False)
    rig.matched()
    assert rig.label == "unconfigured"
    assert rig.call("home").message == "waiting for the driver to be activated"
    for drive in rig.peer.drives:
        drive.silent = True
    assert not rig.transition(Transition.TRANSITION_CONFIGURE)
    assert rig.label == "unconfigured"
    for drive in rig.peer.drives:
        drive.silent = False
    assert rig.transition(Transition.TRANSITION_CONFIGURE)
    assert rig.label == "inactive"


def test_drives_that_come_later_are_waited_for_and_missing_ones_named(make_rig: Make) -> None:
    rig = make_rig()
    rig.peer.drives[1].silent = True
    rig.matched()
    rig.until(lambda: "node 2 does not answer" in rig.call("home").message, "a name")
    rig.peer.drives[1].silent = False
    rig.until(lambda: rig.partner.status.get("state") == "DISABLED", "configured")
    late = make_rig(connect_timeout=0.0)
    late.peer.drives[0].silent = True
    with pytest.raises(UserError, match="insertion axis: node 1 does not answer"):
        late.until(lambda: False, "the end of patience")


def test_on_a_steady_clock_the_driver_sends_its_own_cycles(make_rig: Make) -> None:
    rig = make_rig(use_sim_time=False)
    rig.until(lambda: len(rig.partner.joints) > 5, "joints")
    stamps = [to_nanoseconds(message.header.stamp) for message in rig.partner.joints]
    assert stamps == sorted(stamps)
    assert rig.peer.syncs >= len(stamps)


def test_services_wait_for_the_recorder_where_they_shall(make_rig: Make) -> None:
    rig = make_rig(wait_for_recorder=True)
    rig.matched()
    rig.until(
        lambda: (
            "recorder of" in rig.call("home").message
            and rig.call("home").message.startswith("waiting for")
        ),
        "the recorder",
    )


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"lock_step": True, "use_sim_time": False}, "lock_step wants use_sim_time"),
        ({"insertion_count_per_unit": 1.0}, "did you mean 'insertion_counts_per_unit'"),
        ({"max_speed": 0.006}, "max_speed = 0.006"),
        ({"rotation_node_id": 1}, "the same"),
        ({"lock_step": False, "watchdog": 0.6}, "watchdog = 0.6 s is outside"),
        ({"lock_step": False, "reply_age_limit": 0.6}, "reply_age_limit = 0.6 s is outside"),
    ],
)
def test_bad_parameters_are_refused(make_rig: Make, parameters: dict[str, Any], text: str) -> None:
    with pytest.raises(UserError, match=text):
        make_rig(**parameters)


@pytest.fixture
def domain() -> Iterator[int]:
    with own_domain() as domain:
        yield domain


def test_the_executable_says_in_one_line_what_is_missing_and_ends_on_a_signal(domain: int) -> None:
    command = [sys.executable, "-m", "needle_device_driver.device_driver_node", "--ros-args"]
    command += ["-p", "channel:=/dev/there-is-none"]
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
    missing = subprocess.run(
        [*command, "-p", "connect_timeout:=0.0"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert missing.returncode == 2
    errors = [line for line in missing.stderr.splitlines() if line.startswith("error: ")]
    assert errors == [
        "error: /device_driver: cannot open slcan /dev/there-is-none: No such file or directory"
    ]
    assert "Traceback" not in missing.stderr
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert "looking for the drives" in process.stderr.readline()
        assert "waiting for the drives" in process.stderr.readline()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 0
