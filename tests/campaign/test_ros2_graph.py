"""The small `ros2` in a graph: parameters, and errors; pages type its other commands."""

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

from needle_core.files.installed import find_executable
from needle_core.process.ros_domain import reserve_domain_id

LIMIT = 60.0
Ros2 = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def ros2() -> Iterator[Ros2]:
    """Yield a function that runs `ros2 ARGUMENTS` beside a node with parameters."""
    with reserve_domain_id() as domain:
        context = Context()
        rclpy.init(context=context, domain_id=domain)
        partner = Node("partner", namespace="rig", context=context)
        partner.declare_parameter("speed", 0.005)
        partner.declare_parameter("names", ["a", "b"])
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(partner)

        def spin() -> None:
            try:
                executor.spin()
            except ExternalShutdownException:
                return

        thread = threading.Thread(target=spin)
        thread.start()
        command = find_executable("needle_core", "ros2")
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
        yield lambda *arguments: subprocess.run(
            [command, *arguments],
            check=False,
            env=environment,
            text=True,
            capture_output=True,
            timeout=LIMIT,
        )
        rclpy.try_shutdown(context=context)
        thread.join(LIMIT)
        executor.shutdown()
        partner.destroy_node()


def test_parameters_are_read_and_set(ros2: Ros2) -> None:
    for arguments, output in (
        (("get", "/rig/partner", "speed"), "Double value is: 0.005\n"),
        (("get", "rig/partner", "names"), "String_array value is: ['a', 'b']\n"),
        (("set", "/rig/partner", "speed", "0.25"), "Set parameter successful\n"),
        (("get", "/rig/partner", "speed"), "Double value is: 0.25\n"),
    ):
        assert ros2("param", *arguments).stdout == output


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
