"""The small `ros2` in a running graph: output, sent messages, exit."""

from __future__ import annotations

import os
import subprocess
import threading
from collections.abc import Callable, Iterator

import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Joy
from std_msgs.msg import Header
from std_srvs.srv import SetBool

from needle_core.files.installed import find_executable
from needle_core.process.ros_domain import reserve_domain_id

LIMIT = 60.0
Ros2 = Callable[..., "subprocess.CompletedProcess[str]"]


class Partner(Node):
    """Node that the tested commands list, call and listen to."""

    def __init__(self, context: Context) -> None:
        super().__init__("partner", namespace="rig", context=context)
        self.declare_parameter("speed", 0.005)
        self.declare_parameter("names", ["a", "b"])
        self.received: list[Joy] = []
        self.asked: list[bool] = []
        best_effort = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.create_subscription(Joy, "hold", self.received.append, best_effort)
        self.create_service(SetBool, "enable", self.enable)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.once = self.create_publisher(Header, "status", latched)
        self.once.publish(Header(frame_id="above"))
        self.often = self.create_publisher(Joy, "axes", 10)
        self.create_timer(0.05, lambda: self.often.publish(Joy(axes=[0.5] * 200)))

    def enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self.asked.append(request.data)
        response.success, response.message = request.data, "received"
        return response


@pytest.fixture(scope="module")
def domain() -> Iterator[int]:
    with reserve_domain_id() as domain:
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
def ros2(domain: int, partner: Partner) -> Ros2:
    """Return a function that runs `ros2 ARGUMENTS` in the partner's domain."""
    command = find_executable("needle_core", "ros2")
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
    return lambda *arguments: subprocess.run(
        [command, *arguments],
        check=False,
        env=environment,
        text=True,
        capture_output=True,
        timeout=LIMIT,
    )


def test_lists_nodes_and_topics(ros2: Ros2) -> None:
    # The node of another command is also in the graph, but hidden.
    assert ros2("node", "list").stdout == "/rig/partner\n"
    assert "/rig/hold" in ros2("topic", "list").stdout.splitlines()


def test_echo_receives_earlier_messages_and_shortens_arrays(ros2: Ros2) -> None:
    expected = "stamp:\n  sec: 0\n  nanosec: 0\nframe_id: above\n---\n"
    assert ros2("topic", "echo", "--once", "/rig/status").stdout == expected
    assert ros2("topic", "echo", "--once", "/rig/status", "--field", "frame_id").stdout == (
        "above\n---\n"
    )
    other = ros2("topic", "echo", "/rig/status", "--filter", "not m.frame_id", "--timeout", "1")
    assert other.stdout == ""
    axes = ros2("topic", "echo", "--once", "/rig/axes").stdout
    assert axes.count("- 0.5\n") == 128
    assert "- '...'\n" in axes


def test_pub_sends_the_requested_messages_with_increasing_stamps(
    ros2: Ros2, partner: Partner
) -> None:
    partner.received.clear()
    result = ros2(
        "topic", "pub", "--times", "5", "--rate", "100", "--print", "0", "/rig/hold",
        "sensor_msgs/msg/Joy",
        "{header: {stamp: now, frame_id: me}, axes: [1], buttons: [1]}",
    )  # fmt: skip
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.endswith("publisher: beginning loop\n")
    stamps = [(m.header.stamp.sec, m.header.stamp.nanosec) for m in partner.received]
    assert len(stamps) == 5
    assert sorted(set(stamps)) == stamps
    assert partner.received[0].header.frame_id == "me"
    assert list(partner.received[0].axes) == [1.0]
    assert list(partner.received[0].buttons) == [1]


def test_call_prints_request_and_answer(ros2: Ros2, partner: Partner) -> None:
    partner.asked.clear()
    result = ros2("service", "call", "/rig/enable", "std_srvs/srv/SetBool", "{data: true}")
    assert partner.asked == [True]
    assert "requester: making request: std_srvs.srv.SetBool_Request(data=True)\n" in result.stdout
    answer = "response:\nstd_srvs.srv.SetBool_Response(success=True, message='received')\n\n"
    assert result.stdout.endswith(answer)


def test_parameters_are_read_and_set(ros2: Ros2) -> None:
    assert ros2("param", "get", "/rig/partner", "speed").stdout == "Double value is: 0.005\n"
    assert (
        ros2("param", "get", "rig/partner", "names").stdout == "String_array value is: ['a', 'b']\n"
    )
    assert ros2("param", "set", "/rig/partner", "speed", "0.25").stdout == (
        "Set parameter successful\n"
    )
    assert ros2("param", "get", "/rig/partner", "speed").stdout == "Double value is: 0.25\n"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("topic", "pub", "/t", "sensor_msgs/msg/Joyy"), "no msg type"),
        (("topic", "pub", "/t", "sensor_msgs/msg/Joy", "{axes: [a]}"), "is not a sequence<float>"),
        (("topic", "pub", "/t", "std_msgs/msg/Bool", "{data: ["), "not YAML"),
        (("service", "call", "/s", "std_srvs/msg/SetBool"), "no srv type"),
        (("param", "get", "/nobody", "speed"), "Node not found"),
        (("param", "get", "/rig/partner", "nothing"), "Parameter not set"),
    ],
)
def test_errors_are_one_line(ros2: Ros2, arguments: tuple[str, ...], words: str) -> None:
    result = ros2(*arguments)
    assert result.returncode == 1
    assert words in result.stderr
    assert len(result.stderr.splitlines()) == 1
