"""Who reaches a node that was started with nothing set, and who reads its memory."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from needle_bringup.simulation.node_process import NodeProcess, stop
from needle_core.files.installed import find_executable
from needle_core.process.reach import DISCOVERY_RANGE, PROFILES
from needle_core.process.ros_domain import own_domain, ports_of

LIMIT = 30.0
ADDRESS, STRANGER = "10.213.77.1", "10.213.77.2"

# Asks the address of another namespace for a rig, and presses its emergency stop as long as it
# must: until the one that is open has felt it, then for as long again and two seconds more.
ASK = """
import json, time
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Bool
rclpy.init()
node = rclpy.create_node("stranger")
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
names, stops, heard = ("open", "closed"), {}, {"open": "", "closed": ""}
for name in names:
    stops[name] = node.create_publisher(Bool, f"/{name}/device/estop", 10)
    def take(message, name=name):
        heard[name] = {pair.key: pair.value for pair in message.values}["state"]
    node.create_subscription(DiagnosticStatus, f"/{name}/device/status", take, latched)
begin = time.monotonic()
def press(end):
    while not end():
        for publisher in stops.values():
            publisher.publish(Bool(data=True))
        rclpy.spin_once(node, timeout_sec=0.1)
press(lambda: heard["open"] == "ESTOPPED" or time.monotonic() > begin + %g)
end = time.monotonic() + (time.monotonic() - begin) + 2.0
press(lambda: time.monotonic() > end)
found = sorted(space for name, space in node.get_node_names_and_namespaces() if name != "stranger")
print(json.dumps({"heard": heard, "found": found}))
"""

Start = Callable[..., NodeProcess]

# Package and parameters of each node.
NODES: dict[str, tuple[str, tuple[str, ...]]] = {
    "device_driver": ("needle_device_driver", ("channel:={}/none", "connect_timeout:=600.0")),
    "drive_emulator": ("needle_sim", ("pty:={}/can",)),
    "operator": ("needle_bringup", ("source:=joy", "key:=0")),
    "simulated_operator": ("needle_bringup", ()),
    "plane_controller": ("needle_controller", ()),
}


def bare(domain: int, **more: str) -> dict[str, str]:
    """Return an environment as plain ROS has it: nothing of scripts/env.sh about networks."""
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONUNBUFFERED": "1", **more}
    for name in (DISCOVERY_RANGE, PROFILES):
        if name not in more:
            environment.pop(name, None)
    return environment


@pytest.fixture
def domain() -> Iterator[int]:
    with own_domain() as one:
        yield one


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    processes: list[NodeProcess] = []

    def begin(
        name: str, environment: dict[str, str], *before: str, node: str = "device_driver"
    ) -> NodeProcess:
        package, parameters = NODES[node]
        command = [*before, find_executable(package, node), "--ros-args"]
        for parameter in parameters:
            command += ["-p", parameter.format(tmp_path)]
        command += ["-r", f"__ns:=/{name}"]
        process = NodeProcess(name, command, environment=environment, log=tmp_path / f"{name}.log")
        processes.append(process)
        deadline = time.monotonic() + LIMIT
        while "ROS_DOMAIN_ID" not in process.log.read_text("utf-8"):
            assert process.exit_code is None, process.tail(5)
            assert time.monotonic() < deadline, process.tail(5)
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
    lines = Path(f"/proc/{pid}/net/udp").read_text("ascii").splitlines()[1:]
    found = set()
    for fields in map(str.split, lines):
        address, port = fields[1].split(":")
        if fields[9] in own and int(port, 16) in ports_of(domain):
            found.add(".".join(str(byte) for byte in reversed(bytes.fromhex(address))))
    return found


def test_a_node_listens_to_this_machine_only_unless_asked_otherwise(
    start: Start, domain: int
) -> None:
    closed = start("closed", bare(domain))
    assert listening(closed.pid, domain) == {"127.0.0.1"}
    opened = start("open", bare(domain, **{DISCOVERY_RANGE: "SUBNET"}))
    assert "0.0.0.0" in listening(opened.pid, domain)


def test_another_middleware_is_named_and_not_loaded(domain: int) -> None:
    environment = bare(domain, RMW_IMPLEMENTATION="rmw_cyclonedds_cpp")
    done = subprocess.run(
        [find_executable("needle_sim", "drive_emulator"), "--help"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=LIMIT,
        check=False,
    )
    assert done.returncode == 0
    assert done.stderr == (
        "RMW_IMPLEMENTATION=rmw_cyclonedds_cpp ignored: the rig's nodes run on rmw_fastrtps_cpp\n"
    )


@pytest.mark.parametrize(
    ("node", "asked"),
    [
        ("device_driver", "LOCALHOST"),
        ("device_driver", "SUBNET"),
        ("drive_emulator", "LOCALHOST"),
        ("operator", "LOCALHOST"),
        ("simulated_operator", "LOCALHOST"),
    ],
)
def test_who_must_not_be_held_up_has_no_shared_memory(
    start: Start, domain: int, node: str, asked: str
) -> None:
    process = start("rig", bare(domain, **{DISCOVERY_RANGE: asked}), node=node)
    assert "/dev/shm/fastrtps" not in Path(f"/proc/{process.pid}/maps").read_text("utf-8")


@pytest.fixture
def namespaces() -> Iterator[tuple[str, str]]:
    """Make two network namespaces with one cable between them."""
    ip = shutil.which("ip")
    if ip is None:
        pytest.skip("no `ip` (iproute2) here: no other network to ask from")
    rig, other = (f"needle_{os.getpid()}_{name}" for name in ("rig", "other"))

    def run(words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([ip, *words.split()], capture_output=True, text=True, check=False)

    made = [run(f"netns add {name}") for name in (rig, other)]
    try:
        if any(one.returncode for one in made):
            pytest.skip(f"no network namespaces can be made here: {made[0].stderr.strip()}")
        for words in (
            f"link add needle netns {rig} type veth peer name needle netns {other}",
            f"-n {rig} addr add {ADDRESS}/30 dev needle",
            f"-n {other} addr add {STRANGER}/30 dev needle",
            *(
                f"-n {name} link set {device} up"
                for name in (rig, other)
                for device in ("lo", "needle")
            ),
        ):
            assert run(words).returncode == 0, words
        yield rig, other
    finally:
        for name in (rig, other):
            run(f"netns del {name}")


def test_from_another_network_nothing_is_seen_and_nothing_is_moved(
    start: Start, domain: int, namespaces: tuple[str, str]
) -> None:
    rig, other = namespaces
    inside = ("ip", "netns", "exec", rig)
    closed = start("closed", bare(domain), *inside)
    opened = bare(domain, **{DISCOVERY_RANGE: "SUBNET"})
    start("open", opened, *inside)
    asked = subprocess.run(
        ["ip", "netns", "exec", other, sys.executable, "-c", ASK % LIMIT],
        env=bare(domain, **{DISCOVERY_RANGE: "SUBNET", "ROS_STATIC_PEERS": ADDRESS}),
        capture_output=True,
        text=True,
        check=True,
    )
    seen = json.loads(asked.stdout)
    assert seen["heard"]["open"] == "ESTOPPED", "who asks for a network is reached"
    assert seen["heard"]["closed"] == ""
    assert set(seen["found"]) == {"/open"}
    assert "emergency stop" not in closed.log.read_text("utf-8")
