"""The player as a process of its own, heard by nodes in this one."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosbags.interfaces import Qos, QosDurability, QosReliability
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Joy
from std_msgs.msg import Bool, Int32, String
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from needle_bags.format.bag_metadata import USUAL_QOS
from needle_bags.format.bag_writer import BagWriter
from needle_bags.format.message_definitions import full_definition, type_hash
from needle_bags.ros import player as player_node
from needle_core.files.bag_topic import BagTopic
from needle_core.process.ros_domain import own_domain

PATIENCE = 30.0
START = 1_700_000_000_000_000_000
KEPT = USUAL_QOS._replace(durability=QosDurability.TRANSIENT_LOCAL)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
BEST_EFFORT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
GUARDED = {
    "/device/joint_trajectory": JointTrajectory,
    "/device/hold": Joy,
    "/device/estop": Bool,
    "/target_plane": PoseStamped,
}
# Topics that cannot be played here: another distribution's definition, an unknown type.
OTHERWISE = {"/old": "std_msgs/msg/Header", "/odd": "no_msgs/msg/Such"}


@dataclasses.dataclass
class Listener:
    """Nodes in this process that hear what is played."""

    domain: int

    def __post_init__(self) -> None:
        self.context = Context()
        rclpy.init(context=self.context, domain_id=self.domain)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.node = self.add_node("listener")
        self.heard: dict[str, list[Any]] = {}

    def add_node(self, name: str) -> Node:
        node = Node(name, context=self.context)
        self.executor.add_node(node)
        return node

    def listen(self, topic: str, kind: type, qos: QoSProfile | int = 1000) -> None:
        got = self.heard.setdefault(topic, [])
        self.node.create_subscription(kind, topic, got.append, qos)

    def numbers(self, topic: str) -> list[int]:
        return [int(message.data) for message in self.heard[topic]]

    def wait(self, condition: Callable[[], object], what: str) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, f"waited in vain for {what}"
            self.executor.spin_once(timeout_sec=0.02)

    def close(self) -> None:
        self.executor.shutdown()
        for node in self.executor.get_nodes():
            node.destroy_node()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


@pytest.fixture
def listener() -> Iterator[Listener]:
    with own_domain() as domain:
        one = Listener(domain)
        yield one
        one.close()


class Bag:
    def __init__(self, path: Path) -> None:
        self.path = path
        self.writer = BagWriter(path)
        self.topics: dict[str, int] = {}

    def put(self, topic: str, message: Any, seconds: float, offer: Qos = USUAL_QOS) -> None:
        if topic not in self.topics:
            package, kind = type(message).__module__.split(".")[0], type(message).__name__
            name = f"{package}/msg/{kind}"
            definition = full_definition(name)
            known = BagTopic(topic, name, definition, type_hash(name, definition), (offer,))
            self.topics[topic] = self.writer.add_topic(known)
        time_ns = START + round(seconds * 1e9)
        self.writer.write(self.topics[topic], serialize_message(message), time_ns, time_ns)


def make_bag(path: Path, count: int = 50, period: float = 0.01) -> Path:
    bag = Bag(path)
    bag.put(
        "/plane",
        String(data="latched"),
        0.0,
        USUAL_QOS._replace(durability=QosDurability.TRANSIENT_LOCAL),
    )
    for number in range(count):
        seconds = number * period
        bag.put("/numbered", Int32(data=number), seconds)
        bag.put(
            "/noisy",
            Int32(data=number),
            seconds,
            USUAL_QOS._replace(reliability=QosReliability.BEST_EFFORT),
        )
        bag.put("/clock", Clock(), seconds)
        for topic, kind in GUARDED.items():
            bag.put(topic, kind(), seconds)
    for name, type_name in OTHERWISE.items():
        topic_number = bag.writer.add_topic(BagTopic(name, type_name, "uint32 seq\n"))
        bag.writer.write(topic_number, bytes([0, 1, 0, 0, 0, 0, 0, 0]), START, START)
    bag.writer.close()
    return path


def play(listener: Listener, path: Path, *options: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "needle_bags.ros.player", str(path), *options],
        env={**os.environ, "ROS_DOMAIN_ID": str(listener.domain)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def end(listener: Listener, process: subprocess.Popen[str]) -> tuple[int, str, str]:
    listener.wait(lambda: process.poll() is not None, "the player to end")
    printed, errors = process.communicate()
    return process.returncode, printed, errors


def test_all_is_played_but_nothing_that_a_rig_obeys(listener: Listener, tmp_path: Path) -> None:
    path = make_bag(tmp_path / "bag")
    for topic, kind in GUARDED.items():
        listener.listen(topic, kind)
        listener.listen(f"/replay{topic}", kind)
    listener.listen("/numbered", Int32)
    listener.listen("/noisy", Int32, BEST_EFFORT)
    listener.listen("/clock", Clock)
    seen: set[str] = set()

    def look() -> bool:
        for info in listener.node.get_publishers_info_by_topic("/device/joint_trajectory"):
            seen.add(info.node_name)
        return len(listener.heard["/numbered"]) == 50 == len(listener.heard["/clock"])

    process = play(listener, path)
    listener.wait(look, "all messages")
    code, printed, errors = end(listener, process)
    assert code == 0, errors
    assert "played 351 messages" in printed
    assert "/old is not played: std_msgs/msg/Header is defined otherwise" in errors
    assert "/odd is not played: the definition of no_msgs/msg/Such is not installed" in errors
    assert listener.numbers("/numbered") == listener.numbers("/noisy") == list(range(50))
    for topic in GUARDED:
        assert listener.heard[topic] == []
        assert len(listener.heard[f"/replay{topic}"]) == 50
    assert not seen


def test_part_of_a_bag_under_another_name_at_another_rate(
    listener: Listener, tmp_path: Path
) -> None:
    path = make_bag(tmp_path / "bag", count=100)
    listener.listen("/other", Int32)
    listener.listen("/noisy", Int32, BEST_EFFORT)
    options = "--start 0.2 --end 0.7 --rate 0.5 --topics numbered --remap numbered:=other"
    code, _, errors = end(listener, play(listener, path, *options.split()))
    assert code == 0, errors
    assert listener.numbers("/other") == list(range(20, 71))
    assert not listener.heard["/noisy"]


def test_late_joiners_pause_and_loop(listener: Listener, tmp_path: Path) -> None:
    path = make_bag(tmp_path / "bag")
    listener.listen("/numbered", Int32)
    process = play(listener, path, "--paused", "--loop", "--start", "0.1")
    pause = listener.node.create_client(SetBool, "/player/pause")
    listener.wait(pause.service_is_ready, "the service")
    # The latched message lies before --start: who joins late gets it all the same.
    listener.listen("/plane", String, LATCHED)
    listener.wait(lambda: listener.heard["/plane"], "the latched message")
    assert not listener.heard["/numbered"]
    answer = pause.call_async(SetBool.Request(data=False))
    listener.wait(lambda: listener.numbers("/numbered").count(49) == 2, "two rounds")
    assert answer.result().message == "playing"
    process.send_signal(signal.SIGINT)
    code, _, errors = end(listener, process)
    assert code == 0, errors
    assert listener.numbers("/numbered")[:80] == [*range(10, 50), *range(10, 50)]


def test_seeking_and_another_rate_while_it_plays(listener: Listener, tmp_path: Path) -> None:
    path = make_bag(tmp_path / "bag", count=100, period=10.0)
    listener.listen("/numbered", Int32)
    listener.listen("/noisy", Int32, BEST_EFFORT)
    process = play(listener, path, "--regex", "^/n|plane", "--exclude-regex", "noisy")
    listener.wait(lambda: listener.numbers("/numbered") == [0], "the first message")
    setting = listener.node.create_client(SetParameters, "/player/set_parameters")
    listener.wait(setting.service_is_ready, "the service")

    def set_parameter(name: str, value: float) -> None:
        given = Parameter(name, value=value).to_parameter_msg()
        answer = setting.call_async(SetParameters.Request(parameters=[given]))
        listener.wait(answer.done, "the answer")
        assert [result.successful for result in answer.result().results] == [value > 0.0]

    # A bag of a thousand seconds: nothing but these can play it in time.
    set_parameter("seek", 500.0)
    listener.wait(lambda: listener.numbers("/numbered") == [0, 50], "the 50th")
    set_parameter("seek", 200.0)
    listener.wait(lambda: listener.numbers("/numbered") == [0, 50, 20], "the 20th")
    set_parameter("seek", 200.0)
    listener.wait(lambda: listener.numbers("/numbered") == [0, 50, 20, 20], "the 20th again")
    set_parameter("rate", -1.0)
    set_parameter("rate", 1000.0)
    code, _, errors = end(listener, process)
    assert code == 0, errors
    assert listener.numbers("/numbered") == [0, 50, 20, *range(20, 100)]
    assert not listener.heard["/noisy"]


def test_beside_a_rig_all_is_under_replay(listener: Listener, tmp_path: Path) -> None:
    path = make_bag(tmp_path / "bag", count=5)
    rig = listener.add_node("device_driver")
    rig.create_publisher(DiagnosticStatus, "device/status", LATCHED)
    for topic in ("/numbered", "/replay/numbered", "/clock", "/replay/clock"):
        listener.listen(topic, Clock if "clock" in topic else Int32)
    code, _, errors = end(listener, play(listener, path))
    rig.destroy_node()
    assert code == 0, errors
    assert "all is played under /replay" in errors
    assert not listener.heard["/numbered"]
    assert not listener.heard["/clock"]
    assert listener.numbers("/replay/numbered") == list(range(5))


def test_a_rig_that_comes_up_ends_the_playing(listener: Listener, tmp_path: Path) -> None:
    path = make_bag(tmp_path / "bag")
    listener.listen("/numbered", Int32)
    process = play(listener, path, "--loop")
    listener.wait(lambda: listener.heard["/numbered"], "the first message")
    rig = listener.add_node("device_driver")
    rig.create_publisher(DiagnosticStatus, "/bench/device/status", LATCHED)
    code, _, errors = end(listener, process)
    rig.destroy_node()
    assert code == 1
    assert "device_driver publishes /bench/device/status" in errors


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("{path}/nothing", "no such bag directory"),
        ("{path}/killed", "run `ros2 run needle_bags recover"),
        ("{path}/bag --topics nonsense", "/nonsense is not in"),
        ("{path}/bag --start 9", "--start 9 s"),
        ("{path}/bag --rate fast", "invalid float value"),
        ("{path}/bag --regex (", "is not a regular expression"),
        ("{path}/bag --regex nonsense", "no topic is chosen; it has /plane"),
    ],
)
def test_what_cannot_be_played_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: str, words: str
) -> None:
    make_bag(tmp_path / "bag", count=2)
    (make_bag(tmp_path / "killed", count=2) / "metadata.yaml").unlink()
    assert player_node.main(["player", *arguments.format(path=tmp_path).split()]) == 2
    errors = capsys.readouterr().err
    assert words in errors
    assert errors.count("\n") == 1


def test_a_ros_remapping_does_not_reach_a_rig_either(listener: Listener, tmp_path: Path) -> None:
    remap = ["--ros-args", "-r", "/replay/device/hold:=/device/hold"]
    process = play(listener, make_bag(tmp_path / "bag", count=2), *remap)
    code, _, errors = end(listener, process)
    assert code == 2
    assert "/device/hold may not be played as /device/hold: a rig would obey it" in errors
