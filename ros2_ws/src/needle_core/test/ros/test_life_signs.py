"""A node says that it lives, what it waits for and who else is it."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Bool

from needle_core.commands.hints import with_commands
from needle_core.ros import life_signs
from needle_core.ros.base_node import DiagnosticsPublisher
from needle_core.ros.conversions import RELIABLE
from needle_core.ros.life_signs import LifeSigns
from own_context import own_context

LIMIT = 20.0


def test_it_lives_waits_and_names_who_does_the_same(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(life_signs, "WAIT_PERIOD", 0.05)
    monkeypatch.setattr(life_signs, "_LOOK_PERIOD", 0.05)
    said = ""
    missing = ["publisher of /needle/tip"]
    with own_context() as context:
        node = rclpy.create_node("one", namespace="rig", context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        node.create_publisher(Bool, "topic", 1)
        heard: list[DiagnosticStatus] = []
        node.create_subscription(
            DiagnosticArray, "/diagnostics", lambda message: heard.extend(message.status), RELIABLE
        )
        diagnostics = DiagnosticsPublisher(node)

        def until(text: str, condition: Callable[[int], bool] = bool) -> None:
            nonlocal said
            deadline = time.monotonic() + LIMIT
            while not condition(said.count(text)):
                assert time.monotonic() < deadline, said
                executor.spin_once(timeout_sec=0.05)
                said += capfd.readouterr().err

        signs = LifeSigns(node, diagnostics, "is one", lambda: missing, alone_on=("topic",))
        until("is one (ROS_DOMAIN_ID ")
        until(
            "waiting for publisher of /needle/tip (ros2 run needle_tracker stereo_tracker)",
            lambda count: count >= 2,
        )
        missing.clear()
        assert "is published by" not in said
        other = rclpy.create_node("two", context=context)
        other.create_publisher(Bool, "/rig/topic", 1)
        until("/rig/topic is published by ")
        line = next(line for line in said.splitlines() if "is published by" in line)
        assert "/rig/one" in line
        assert "/two" in line
        until("", lambda _: bool(heard))
        assert {status.name for status in heard} == {"rig/one: duplicates"}
        assert {status.hardware_id for status in heard} == {"rig/one"}
        other.destroy_node()
        del signs
        executor.shutdown()
        node.destroy_node()


def test_each_missing_thing_comes_with_the_command_that_brings_it() -> None:
    said = with_commands(
        [
            "publisher of /rig/needle/controller_status",
            "publisher of /rig/device/joint_trajectory",
            "publisher of /rig/device/hold",
            "something else",
        ]
    )
    assert said == (
        "publisher of /rig/needle/controller_status, publisher of /rig/device/joint_trajectory "
        "(ros2 run needle_controller plane_controller); publisher of /rig/device/hold (ros2 run "
        "needle_bringup operator; simulated: ros2 run needle_bringup simulated_operator); "
        "something else"
    )
