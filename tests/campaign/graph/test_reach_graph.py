"""Network reach and shared memory of a node with default environment."""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from campaign.trials.holds.computers import ADDRESSES, two_computers
from needle_bringup.simulation.node_graph import NodeProcess, stop
from needle_core.files.installed import find_executable
from needle_core.process.discovery import DISCOVERY_RANGE, PROFILES
from needle_core.process.ros_domain import ports_of, reserve_domain_id

LIMIT = 30.0
OPEN = {DISCOVERY_RANGE: "SUBNET"}
# Sends emergency stops to both rigs on the other computer until the open one is stopped, then for
# the same time again and two seconds.
ASK = """
import json, time
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Bool
rclpy.init()
node = rclpy.create_node("stranger")
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
names, stops, states = ("open", "closed"), {}, {"open": "", "closed": ""}
for name in names:
    stops[name] = node.create_publisher(Bool, f"/{name}/device/estop", 10)
    def take(message, name=name):
        states[name] = {pair.key: pair.value for pair in message.values}["state"]
    node.create_subscription(DiagnosticStatus, f"/{name}/device/status", take, latched)
begin = time.monotonic()
def press(end):
    while not end():
        for publisher in stops.values():
            publisher.publish(Bool(data=True))
        rclpy.spin_once(node, timeout_sec=0.1)
press(lambda: states["open"] == "ESTOPPED" or time.monotonic() > begin + 30.0)
end = time.monotonic() + (time.monotonic() - begin) + 2.0
press(lambda: time.monotonic() > end)
found = sorted(space for name, space in node.get_node_names_and_namespaces() if name != "stranger")
print(json.dumps({"states": states, "found": found}))
"""
# Package and parameters of each node.
NODES = {
    "device_driver": ("needle_device_driver", ("channel:={}/none", "connect_timeout:=600.0")),
    "drive_emulator": ("needle_sim", ("pty:={}/can",)),
    "operator": ("needle_bringup", ("source:=joy", "key:=0")),
    "simulated_operator": ("needle_bringup", ()),
}
Start = Callable[..., NodeProcess]


@pytest.fixture
def domain() -> Iterator[int]:
    with reserve_domain_id() as one:
        yield one


def bare(domain: int, **more: str) -> dict[str, str]:
    """Return the environment without the network settings of scripts/env.sh."""
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONUNBUFFERED": "1"}
    for name in (DISCOVERY_RANGE, PROFILES):
        environment.pop(name, None)
    return environment | more


@pytest.fixture
def start(tmp_path: Path, domain: int) -> Iterator[Start]:
    processes: list[NodeProcess] = []

    def begin(name: str, *before: str, node: str = "device_driver", **more: str) -> NodeProcess:
        package, parameters = NODES[node]
        command = [*before, find_executable(package, node), "--ros-args", "-r", f"__ns:=/{name}"]
        for parameter in parameters:
            command += ["-p", parameter.format(tmp_path)]
        log = tmp_path / f"{name}.log"
        process = NodeProcess(name, command, environment=bare(domain, **more), log=log)
        processes.append(process)
        deadline = time.monotonic() + LIMIT
        while "ROS_DOMAIN_ID" not in process.log.read_text("utf-8"):
            assert process.exit_code is None and time.monotonic() < deadline, process.tail(5)
        return process

    yield begin
    stop(processes)


def listening(pid: int, domain: int) -> set[str]:
    """Return the addresses at which a process listens on ports of its domain."""
    own = set()
    for file in Path(f"/proc/{pid}/fd").iterdir():
        # It may have been closed meanwhile.
        with contextlib.suppress(FileNotFoundError):
            if match := re.fullmatch(r"socket:\[(\d+)\]", str(file.readlink())):
                own.add(match[1])
    found = set()
    for line in Path(f"/proc/{pid}/net/udp").read_text("ascii").splitlines()[1:]:
        fields = line.split()
        address, port = fields[1].split(":")
        if fields[9] in own and int(port, 16) in ports_of(domain):
            found.add(".".join(str(byte) for byte in reversed(bytes.fromhex(address))))
    return found


def test_a_node_listens_to_this_machine_only_unless_asked_otherwise(
    start: Start, domain: int
) -> None:
    assert listening(start("closed").pid, domain) == {"127.0.0.1"}
    assert "0.0.0.0" in listening(start("open", **OPEN).pid, domain)


@pytest.mark.parametrize("node", NODES)
def test_nodes_that_must_not_block_use_no_shared_memory(start: Start, node: str) -> None:
    asked = OPEN if node == "device_driver" else {DISCOVERY_RANGE: "LOCALHOST"}
    process = start("rig", node=node, **asked)
    assert "/dev/shm/fastrtps" not in Path(f"/proc/{process.pid}/maps").read_text("utf-8")


def test_another_computer_neither_discovers_nor_stops_a_closed_rig(
    start: Start, domain: int
) -> None:
    with two_computers() as (rig, other, _):
        closed = start("closed", *rig.inside)
        start("open", *rig.inside, **OPEN)
        asked = subprocess.run(
            [*other.inside, sys.executable, "-c", ASK],
            env=bare(domain, ROS_STATIC_PEERS=ADDRESSES[0], **OPEN),
            capture_output=True,
            text=True,
            check=True,
        )
    reached = json.loads(asked.stdout)
    assert reached["states"] == {"open": "ESTOPPED", "closed": ""}
    assert set(reached["found"]) == {"/open"}
    assert "emergency stop" not in closed.log.read_text("utf-8")
