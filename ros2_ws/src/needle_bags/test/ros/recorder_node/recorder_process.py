"""A recorder as a process, what it is sent, and what its bag holds."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
PATIENCE = 20.0
RECORDER = (sys.executable, "-m", "needle_bags.ros.recorder")


class Source:
    """A node in this process that publishes into the domain."""

    def __init__(self, domain: int) -> None:
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = Node("source", context=self.context)
        self.node.declare_parameter("gain", 1.5)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def wait(self, condition: Callable[[], object], what: str) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, f"waited in vain for {what}"
            self.executor.spin_once(timeout_sec=0.02)

    def publisher(self, kind: type, topic: str, qos: QoSProfile | int = 1000) -> Any:
        return self.node.create_publisher(kind, topic, qos)

    def wait_matched(self, *publishers: Any) -> None:
        self.wait(
            lambda: all(p.get_subscription_count() for p in publishers), "the recorder to subscribe"
        )

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


def start(domain: int, *parameters: str, largest_file: int = 0) -> subprocess.Popen[str]:
    arguments = ["--ros-args"]
    for parameter in parameters:
        arguments += ["-r" if parameter.startswith("__") else "-p", parameter]
    limit = ["prlimit", f"--fsize={largest_file}:unlimited"] if largest_file else []
    return subprocess.Popen(
        [*limit, *RECORDER, *arguments],
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def end(process: subprocess.Popen[str], number: int = signal.SIGTERM) -> tuple[int, str, str]:
    process.send_signal(number)
    try:
        printed, errors = process.communicate(timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise
    return process.returncode, printed, errors


def numbers(bag: Path, topic: str) -> list[int]:
    with AnyReader([bag]) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        return [
            int(reader.deserialize(data, c.msgtype).data)  # type: ignore[attr-defined]
            for c, _, data in reader.messages(connections=connections)
            if c.topic == topic  # no connections stand for all
        ]
