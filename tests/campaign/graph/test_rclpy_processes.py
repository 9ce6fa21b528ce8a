"""Behaviour of `needle_core` that needs real processes or rcl."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import sys
import uuid
from pathlib import Path

import pytest
from rclpy.context import Context
from rclpy.node import Node

from needle_core.errors import UserError
from needle_core.process.ros_domain import FIRST_PARTICIPANT, Claim, ports_of, reserve_domain_id
from needle_core.process.shared_memory import SHARED_MEMORY
from needle_core.settings.parameter_files import values_for


def test_a_node_starts_after_a_port_was_left_incomplete() -> None:
    code = """
import sys
from rclpy.node import Node
from needle_core.ros.main import run_node
node = lambda: Node("one")
spin = lambda node, end: 7
sys.exit(run_node(node, help_text="", parameters=object, args=["one"], spin=spin))
"""
    with reserve_domain_id() as domain:
        # Port of user data; the preceding port is for discovery.
        port = ports_of(domain)[FIRST_PARTICIPANT + 1]
        (SHARED_MEMORY / f"fastrtps_port{port}").write_bytes(b"")
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, env=environment, timeout=30.0, check=False)
    assert done.returncode == 7


PUBLISHER = """
import sys
import time
from rclpy.node import Node
from std_msgs.msg import String
from needle_core.ros.main import run_node
from needle_core.ros.base_node import RELIABLE

class Publisher(Node):
    def __init__(self):
        super().__init__("publisher")
        self.words = self.create_publisher(String, "words", RELIABLE)

    def destroy_node(self):
        print("goes", flush=True)
        super().destroy_node()

def spin(node, end):
    while not node.words.get_subscription_count():
        time.sleep(0.01)
    print("has a subscriber", flush=True)
    sys.stdin.readline()
    for number in range(10):
        node.words.publish(String(data=str(number)))
    print("has published", flush=True)
    return 7

sys.exit(run_node(Publisher, help_text="", parameters=object, args=["publisher"], spin=spin))
"""
SUBSCRIBER = """
import sys
from rclpy.node import Node
from std_msgs.msg import String
from rclpy.executors import SingleThreadedExecutor
from needle_core.ros.main import run_node
from needle_core.ros.base_node import RELIABLE

def spin(node, end):
    received = []
    node.create_subscription(String, "words", lambda word: received.append(word.data), RELIABLE)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while "9" not in received:
        executor.spin_once(timeout_sec=0.1)
    print(*received, flush=True)
    return 0

node = lambda: Node("subscriber")
sys.exit(run_node(node, help_text="", parameters=object, args=["subscriber"], spin=spin))
"""


def test_a_node_exits_after_a_stalled_subscriber_has_its_messages() -> None:
    with reserve_domain_id() as domain, contextlib.ExitStack() as ends:

        def start(code: str) -> subprocess.Popen[bytes]:
            process = subprocess.Popen(
                [sys.executable, "-c", code],
                env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                # Unbuffered, so that select() finds the remaining output.
                bufsize=0,
            )
            ends.enter_context(process)
            ends.callback(process.kill)
            return process

        publisher, subscriber = start(PUBLISHER), start(SUBSCRIBER)
        assert publisher.stdin is not None
        assert publisher.stdout is not None
        assert publisher.stdout.readline() == b"has a subscriber\n"
        subscriber.send_signal(signal.SIGSTOP)
        # Wait until all of its threads are stopped.
        os.waitid(os.P_PID, subscriber.pid, os.WSTOPPED)
        try:
            publisher.stdin.write(b"\n")
            assert publisher.stdout.readline() == b"has published\n"
            assert select.select([publisher.stdout], [], [], 1.5)[0] == []
        finally:
            subscriber.send_signal(signal.SIGCONT)
        assert publisher.wait(30.0) == 7
        assert subscriber.communicate(timeout=30.0)[0].split() == b"0 1 2 3 4 5 6 7 8 9".split()


CLAIMS = """
import sys
from needle_core.process.ros_domain import Claim
claim = Claim(sys.argv[1], "/first")
print("has it", flush=True)
sys.stdin.read()
"""


def test_a_kill_releases_the_name_of_a_process() -> None:
    name = f"/device/status {uuid.uuid4()}"
    with subprocess.Popen(
        [sys.executable, "-c", CLAIMS, name], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as first:
        assert first.stdout is not None
        assert first.stdout.readline() == b"has it\n"
        with pytest.raises(UserError, match=rf"/first \(process {first.pid}\) has {name}"):
            Claim(name, "/second")
        first.kill()
        first.wait()
        Claim(name, "/second").release()


REMAPPINGS = {
    "/device_driver": (),
    "/rig1/device_driver": ("-r", "__ns:=/rig1"),
    "/a/b/device_driver": ("-r", "__ns:=/a/b"),
    "/other": ("-r", "__node:=other"),
    "/rig1/other": ("-r", "device_driver:__node:=other", "-r", "other:__ns:=/rig1"),
}
NAMES = (
    *("device_driver", "/device_driver", "other", "/rig1/device_driver", "rig1/device_driver"),
    *("/rig1/other", "/rig2/device_driver", "/a/b/device_driver", "/**", "/*", "/*/*", "/rig1/*"),
    *("/rig1/**", "/a/**", "/**/device_driver", "/**/other", "/*/device_driver", "**", "/**/b/*"),
    *("/rig1/**/device_driver", "/**/rig1/device_driver", "/a/*/device_driver", "**/device_driver"),
)


@pytest.mark.parametrize("node", REMAPPINGS)
def test_a_node_gets_the_same_sections_as_from_rcl(tmp_path: Path, node: str) -> None:
    sections = {name: {f"p{i}": i, "last": i} for i, name in enumerate(NAMES)}
    file = tmp_path / "p.yaml"
    file.write_text("".join(f"'{n}': {{ros__parameters: {v}}}\n" for n, v in sections.items()))
    with reserve_domain_id() as domain:
        context = Context()
        words = ["--ros-args", "--params-file", str(file), *REMAPPINGS[node]]
        context.init(["node", *words], domain_id=domain)
        made = Node("device_driver", context=context)
        given = {name: one.value for name, one in made._parameter_overrides.items()}
        assert made.get_fully_qualified_name() == node
        made.destroy_node()
        context.try_shutdown()
    assert given == values_for(file, sections, node, "device_driver")
