"""The small `ros2` in a running graph: what it prints, what it sends, how it ends."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Joy
from std_msgs.msg import Header
from std_srvs.srv import SetBool

from needle_core.process.ros_domain import own_domain

STAND_IN = Path(__file__).parents[2] / "scripts" / "lib" / "ros2_standin.py"
LIMIT = 60.0


class Partner(Node):
    """A node to look at and to speak to."""

    def __init__(self, context: Context) -> None:
        super().__init__("partner", namespace="rig", context=context)
        self.declare_parameter("speed", 0.005)
        self.declare_parameter("names", ["a", "b"])
        self.declare_parameter("count", 3)
        self.heard: list[Joy] = []
        self.asked: list[bool] = []
        best_effort = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.create_subscription(Joy, "hold", self.heard.append, best_effort)
        self.create_service(SetBool, "enable", self.enable)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.once = self.create_publisher(Header, "status", latched)
        self.once.publish(Header(frame_id="above"))
        self.often = self.create_publisher(Joy, "axes", 10)
        self.create_timer(0.05, lambda: self.often.publish(Joy(axes=[0.5] * 200)))

    def enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self.asked.append(request.data)
        response.success, response.message = request.data, "heard"
        return response


@pytest.fixture(scope="module")
def domain() -> Iterator[int]:
    with own_domain() as domain:
        yield domain


@pytest.fixture(scope="module")
def partner(domain: int) -> Iterator[Partner]:
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = Partner(context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def spin() -> None:
        try:
            executor.spin()
        except ExternalShutdownException:
            return

    thread = threading.Thread(target=spin)
    thread.start()
    yield node
    rclpy.try_shutdown(context=context)
    thread.join(LIMIT)
    executor.shutdown()
    node.destroy_node()


@pytest.fixture
def ros2(domain: int, partner: Partner) -> type[Ros2]:
    del partner
    Ros2.domain = domain
    return Ros2


class Ros2:
    """`ros2 ARGUMENTS` in the partner's domain."""

    domain = 0

    def __init__(self, *arguments: str) -> None:
        result = subprocess.run(
            self.command(*arguments),
            check=False,
            env=self.environment(),
            text=True,
            capture_output=True,
            timeout=LIMIT,
        )
        self.code, self.out, self.err = result.returncode, result.stdout, result.stderr

    @staticmethod
    def command(*arguments: str) -> list[str]:
        return [sys.executable, "-I", "-S", str(STAND_IN), *arguments]

    @classmethod
    def environment(cls) -> dict[str, str]:
        return {**os.environ, "ROS_DOMAIN_ID": str(cls.domain)}


def at_once(ros2: type[Ros2], *commands: str) -> list[Ros2]:
    """Run commands side by side: each waits for seconds."""
    with ThreadPoolExecutor() as pool:
        return list(pool.map(lambda command: ros2(*shlex.split(command)), commands))


def test_lists_nodes_topics_services_and_parameters(ros2: type[Ros2]) -> None:
    # Another command's node is in the graph, too, but hidden.
    nodes, topics, services, parameters = at_once(
        ros2,
        "node list --spin-time 3",
        "topic list -t --spin-time 3",
        "service list --spin-time 3",
        "param list /rig/partner",
    )
    assert nodes.out == "/rig/partner\n"
    assert "/rig/hold [sensor_msgs/msg/Joy]" in topics.out.splitlines()
    assert "/rig/enable" in services.out.splitlines()
    assert "  speed\n" in parameters.out


STAMPED = "stamp:\n  sec: 0\n  nanosec: 0\nframe_id: above\n---\n"


@pytest.mark.parametrize(
    ("words", "out"),
    [
        ("topic echo --once /rig/status", STAMPED),
        ("topic echo --once /rig/status --field frame_id", "above\n---\n"),
        ("topic echo /rig/status --filter 'not m.frame_id' --timeout 1", ""),
        ("topic echo --once /rig/status --filter m.frame_id", STAMPED),
        ("param get /rig/partner speed", "Double value is: 0.005\n"),
        ("param get rig/partner names", "String values are: ['a', 'b']\n"),
        ("param set /rig/partner count 7", "Set parameter successful\n"),
        ("param get --hide-type /rig/partner count", "7\n"),
    ],
)
def test_prints_what_ros2_prints(ros2: type[Ros2], words: str, out: str) -> None:
    assert ros2(*shlex.split(words)).out == out


def test_echo_shortens_long_arrays(ros2: type[Ros2]) -> None:
    axes = ros2("topic", "echo", "--once", "/rig/axes").out
    assert axes.count("- 0.5\n") == 128
    assert "- '...'\n" in axes


def test_pub_sends_so_many_messages_with_stamps_that_increase(
    ros2: type[Ros2], partner: Partner
) -> None:
    partner.heard.clear()
    said = ros2(
        "topic", "pub", "--times", "5", "--rate", "100", "--print", "0", "/rig/hold",
        "sensor_msgs/msg/Joy",
        "{header: {stamp: now, frame_id: me}, axes: [1], buttons: [1]}",
    )  # fmt: skip
    assert (said.code, said.err) == (0, "")
    assert said.out.endswith("publisher: beginning loop\n")
    stamps = [(m.header.stamp.sec, m.header.stamp.nanosec) for m in partner.heard]
    assert len(stamps) == 5
    assert sorted(set(stamps)) == stamps
    assert partner.heard[0].header.frame_id == "me"
    assert list(partner.heard[0].axes) == [1.0]
    assert list(partner.heard[0].buttons) == [1]


def test_call_prints_request_and_answer(ros2: type[Ros2], partner: Partner) -> None:
    partner.asked.clear()
    said = ros2("service", "call", "/rig/enable", "std_srvs/srv/SetBool", "{data: true}")
    assert partner.asked == [True]
    assert "requester: making request: std_srvs.srv.SetBool_Request(data=True)\n" in said.out
    answer = "response:\nstd_srvs.srv.SetBool_Response(success=True, message='heard')\n\n"
    assert said.out.endswith(answer)


def test_an_answer_that_never_comes_is_told(domain: int, ros2: type[Ros2]) -> None:
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    deaf = Node("deaf", context=context)  # never spun
    deaf.create_service(SetBool, "deaf/enable", lambda _, response: response)
    call, get = at_once(
        ros2,
        "service call /deaf/enable std_srvs/srv/SetBool '{data: true}'",
        "param get /deaf speed",
    )
    assert (call.code, call.err) == (1, "no answer from /deaf/enable\n")
    assert (get.code, get.err) == (1, "no answer from /deaf\n")
    deaf.destroy_node()
    rclpy.try_shutdown(context=context)


def test_hz_prints_once_a_second(ros2: type[Ros2]) -> None:
    with subprocess.Popen(
        Ros2.command("topic", "hz", "/rig/axes"), env=Ros2.environment(), text=True,
        stdout=subprocess.PIPE,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert process.stdout.readline().startswith("average rate: ")
        assert process.stdout.readline().startswith("\tmin: ")
        process.terminate()
        process.wait(LIMIT)


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ("topic pub /t sensor_msgs/msg/Joyy", "message type is invalid"),
        ("topic pub /t sensor_msgs/msg/Joy '{axes: [a]}'", "no sequence<float>"),
        ("topic pub /t sensor_msgs/msg/Joy '{axis: [1]}'", "no field 'axis'"),
        ("topic pub /t std_msgs/msg/Bool '{data: 1}'", "'data' cannot be 1"),
        ("topic pub /t std_msgs/msg/Bool true", "needs to be a dictionary"),
        ("topic pub /t std_msgs/msg/Bool '{data: ['", "not YAML"),
        ("service call /s std_srvs/msg/SetBool", "service type is invalid"),
        ("param get /nobody speed --timeout 0.5", "Node not found"),
        ("param get /rig/partner nothing", "Parameter not set"),
    ],
)
def test_says_in_one_line_what_is_wrong(ros2: type[Ros2], arguments: str, error: str) -> None:
    said = ros2(*shlex.split(arguments))
    assert said.code == 1
    assert error in said.err
    assert len(said.err.splitlines()) == 1
