"""The device_driver node: steps and refusals over DDS, start and end."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from builtin_interfaces.msg import Time
from sensor_msgs.msg import Joy
from std_msgs.msg import Bool

from needle_core.errors import UserError
from needle_core.process.ros_domain import own_domain

from .node_bench import Make


def test_a_step_ends_where_it_should_and_its_answer_has_its_stamp(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    message = rig.message()
    assert rig.send(message).frame_id == "succeeded"
    assert rig.partner.results[-1].stamp == message.header.stamp
    assert rig.positions == [20_000, round(0.1 * 65536 / (2 * math.pi))]


def test_the_last_stamp_that_there_is_is_refused_and_answered(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    message = rig.message()
    message.header.stamp = Time(sec=2**31 - 1, nanosec=2**32 - 1)
    answer = rig.send(message)
    assert "from the future" in answer.frame_id
    assert answer.stamp == message.header.stamp


def test_a_long_command_or_hold_is_refused_unread(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    rig.partner.commands.publish(rig.message(points=10_000))
    long_name = Joy(axes=[1.0], buttons=[1])
    long_name.header.frame_id = "n" * 1_000_000
    rig.partner.holds.publish(long_name)
    rig.until(lambda: set(rig.partner.refused) == {"device/joint_trajectory", "device/hold"}, "two")
    assert rig.send(rig.message()).frame_id == "succeeded"
    assert rig.partner.status["commands_refused"] == "0"


def test_the_emergency_stop_stops_both_drives_and_its_reset_moves_nothing(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    rig.partner.commands.publish(rig.message(duration=1.0))
    rig.until(lambda: rig.partner.status["state"] == "MOVING", "step")
    rig.partner.estops.publish(Bool(data=True))
    rig.until(lambda: rig.partner.status["state"] == "ESTOPPED", "emergency stop")
    rig.until(
        lambda: [drive.state for drive in rig.peer.drives] == ["quick stop"] * 2, "quick stops"
    )
    at = rig.positions
    rig.partner.estops.publish(Bool(data=False))
    rig.hold(False)
    rig.insist("reset")
    rig.until(lambda: rig.partner.status["state"] == "DISABLED", "reset")
    assert rig.positions == at


def test_drives_that_fall_silent_are_a_fault(make_rig: Make) -> None:
    """The port's thread and the node read one clock: else a reply would never be old."""
    rig = make_rig()
    rig.ready()
    for drive in rig.peer.drives:
        drive.silent = True
    rig.until(lambda: rig.partner.status["state"] == "FAULT", "the fault")
    assert "reply" in rig.partner.status["fault"]


def test_its_end_in_the_middle_of_a_step_leaves_the_drives_off(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    rig.partner.commands.publish(rig.message(duration=1.0))
    rig.until(lambda: rig.partner.status["state"] == "MOVING", "step")
    rig.driver.stop()
    rig.until(lambda: rig.driver.exit is not None, "its end")
    assert rig.driver.exit is not None
    assert rig.driver.exit.code == 0
    assert not any(drive.state == "enabled" for drive in rig.peer.drives)


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"insertion_count_per_unit": 1.0}, "did you mean 'insertion_counts_per_unit'"),
        ({"max_speed": 0.006}, "max_speed = 0.006"),
        ({"rotation_node_id": 1}, "the same"),
        ({"watchdog": 0.6}, "watchdog = 0.6 is outside"),
        ({"reply_age_limit": 0.6}, "reply_age_limit = 0.6"),
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
    command = [sys.executable, "-m", "needle_device_driver.ros.device_driver", "--ros-args"]
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
    last = missing.stderr.splitlines()[-1]
    assert last.startswith("device_driver: ")
    assert last.endswith("cannot open slcan /dev/there-is-none: No such file or directory")
    assert "Traceback" not in missing.stderr
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert "runs" in process.stderr.readline()
        assert "waiting for the drives" in process.stderr.readline()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 0
