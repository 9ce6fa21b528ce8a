"""drive_emulator as a process: its link, its commands, its positions, its end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import canopen
import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState

from needle_core.process.ros_domain import own_domain
from needle_core.ros.conversions import JOINT_STATES, to_nanoseconds
from needle_sim.drive_emulator_parameters import DriveEmulatorParameters

LIMIT = 20.0


class Emulator:
    """The process, and a node that hears what it publishes."""

    def __init__(self, domain: int, folder: Path, *parameters: str) -> None:
        self.link = folder / "can"
        self.log = folder / "log"
        command = [sys.executable, "-m", "needle_sim.ros.drive_emulator", "--ros-args"]
        for parameter in (f"pty:={self.link}", *parameters):
            command += ["-p", parameter]
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [*command, "--disable-external-lib-logs"],
                env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
        self.heard: list[JointState] = []
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = Node("listener", context=self._context)
        self._node.create_subscription(
            JointState, "sim/drive_positions", self.heard.append, JOINT_STATES
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)

    def until(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < deadline, self.log.read_text()
            assert self.process.poll() is None, self.log.read_text()
            self._executor.spin_once(timeout_sec=0.01)

    def say(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n".encode())
        self.process.stdin.flush()

    def end(self, number: signal.Signals) -> int:
        self.process.send_signal(number)
        code = self.process.wait(LIMIT)
        assert self.process.stdin is not None
        self.process.stdin.close()
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)
        return code


@pytest.fixture
def emulator(tmp_path: Path) -> Iterator[Emulator]:
    with own_domain() as domain:
        emulator = Emulator(domain, tmp_path, "insertion_start:=0.001")
        try:
            yield emulator
        finally:
            emulator.process.kill()
            emulator.process.wait()


def test_tells_where_the_motors_are_and_leaves_nothing(emulator: Emulator) -> None:
    emulator.until(emulator.link.exists)
    network = canopen.Network()
    network.connect(interface="slcan", channel=str(emulator.link), sleep_after_open=0)

    try:
        emulator.until(lambda: _answers(network.add_node(1, None)))
        emulator.until(lambda: len(emulator.heard) > 0)
        heard = emulator.heard[-1]
        assert list(heard.name) == ["insertion_joint", "rotation_joint"]
        assert list(heard.position) == [0.001, 0.0]
        assert to_nanoseconds(heard.header.stamp) > 0
        emulator.say("emcy rotation 0x5530")
        emulator.until(lambda: "rotation drive: fault 0x5530" in emulator.log.read_text())
        emulator.say("nonsense")
        emulator.until(lambda: "no command" in emulator.log.read_text())
    finally:
        network.disconnect()
    assert emulator.end(signal.SIGTERM) == 0
    assert not emulator.link.is_symlink()
    assert "Traceback" not in emulator.log.read_text()


def _answers(node: Any) -> bool:
    try:
        return bool(node.sdo.upload(0x1008, 0) == b"Emulated insertion drive")
    except canopen.SdoCommunicationError:
        return False


@pytest.mark.parametrize(
    "bad",
    [
        {"insertion_node_id": 2},
        {"limit_action": "ignore"},
        {"insertion_start": 0.3},
    ],
)
def test_refuses_what_cannot_be(bad: dict[str, Any]) -> None:
    with pytest.raises(Exception, match=r"node id|one of|beyond"):
        DriveEmulatorParameters(**bad)
