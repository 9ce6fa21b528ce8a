"""Random messages and requests to every node of a rig: none ends, none grows, nothing moves."""

from __future__ import annotations

import random
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from needle_bags.format.message_definitions import message_class
from needle_core.ros.conversions import JOINT_STATES, LATCHED, values_of
from needle_verification.ros.listening_node import ListeningNode
from needle_verification.trials.random_messages import random_message
from needle_verification.trials.trial_processes import TrialProcesses, graph_in_real_time

_READY = 120.0
_LEFT_OUT = ("simulated_operator",)
# A second one of these is a fault by itself: only in the second half.
_ONE_ONLY = ("/clock", "/device/status")
# Asked for, an end is an end; confirmed, a homing is a motion.
_ENDS = frozenset(
    (
        Transition.TRANSITION_UNCONFIGURED_SHUTDOWN,
        Transition.TRANSITION_INACTIVE_SHUTDOWN,
        Transition.TRANSITION_ACTIVE_SHUTDOWN,
    )
)
_OURS = "fuzz"
_PERIOD = 0.005
_LONGEST_QUEUE = 50
# By then each node has seen everything once, and has the memory that it takes for good, on a busy
# machine too [s].
_SEEN_ONCE = 3.0


def fuzz_trials(folder: Path, domain: int, seconds: float, seed: int) -> Iterator[dict[str, Any]]:
    """Yield what came of so many seconds of each half, a graph of its own.

    Parameters
    ----------
    folder : Path
        Takes the logs.
    domain : int
        ROS_DOMAIN_ID.
    seconds : float
        Of both halves together [s].
    seed : int
        Of all that is sent.
    """
    parameters = graph_in_real_time(seed)
    for name in _LEFT_OUT:
        parameters.pop(name)
    parameters["recorder"] = {"bag": str(folder / "bag")}
    rng = random.Random(seed)
    with (
        closing(_Witness()) as witness,
        closing(TrialProcesses(folder, domain, parameters)) as processes,
    ):
        witness.until(lambda: witness.state == "DISABLED", "a driver", _READY)
        nodes = {name.lstrip("/") for name in parameters}
        fuzzer = _Fuzzer(witness, nodes, rng)
        witness.until(lambda: fuzzer.look_around() >= nodes, "all nodes", _READY)
        for half in ("without clocks and devices", "with"):
            if half == "with":
                fuzzer.left_out = ()
                fuzzer.look_around()
            yield {"fuzz": half, **_half(processes, witness, fuzzer, seconds / 2.0)}


def _half(
    processes: TrialProcesses, witness: _Witness, fuzzer: _Fuzzer, seconds: float
) -> dict[str, Any]:
    begun, fuzzer.sent = time.monotonic(), 0
    memory: dict[str, int] = {}
    witness.places.clear()
    while time.monotonic() < begun + seconds:
        fuzzer.send()
        witness.look(_PERIOD)
        processes.check()
        if not memory and time.monotonic() > begun + max(0.2 * seconds, _SEEN_ONCE):
            memory = processes.memories()
    grown = {name: (now - memory[name]) / 1e6 for name, now in processes.memories().items()}
    return {
        "sent": fuzzer.sent,
        "topics": len(fuzzer.publishers),
        "services": len(fuzzer.clients_of),
        "moved": len(witness.places) > 1,
        "memory_growth_MB": grown,
    }


class _Witness(ListeningNode):
    """Sees the driver's first state, and whether a motor turned, by the emulator's own word."""

    def __init__(self) -> None:
        super().__init__("fuzz")
        self.state = ""
        self.places: set[tuple[float, ...]] = set()
        self.create_subscription(DiagnosticStatus, "device/status", self._on_status, LATCHED)
        self.create_subscription(
            JointState, "sim/drive_positions", self._on_positions, JOINT_STATES
        )

    def _on_status(self, message: DiagnosticStatus) -> None:
        self.state = values_of(message).get("state", "")

    def _on_positions(self, message: JointState) -> None:
        if message.header.frame_id != _OURS:
            self.places.add(tuple(message.position))


class _Fuzzer:
    """Speaks to every topic and service that the nodes of a rig have."""

    def __init__(self, node: Node, names: set[str], rng: random.Random) -> None:
        self._node = node
        self._names = names
        self._rng = rng
        self.left_out: tuple[str, ...] = _ONE_ONLY
        self.sent = 0
        self.publishers: dict[str, tuple[Any, Any]] = {}
        self.clients_of: dict[str, tuple[Any, Any]] = {}

    def look_around(self) -> set[str]:
        """Get to know what the nodes hear; return the names of those that are there."""
        there = set()
        for name, namespace in self._node.get_node_names_and_namespaces():
            if name not in self._names and name.strip("_").removesuffix("_parameters") not in (
                self._names
            ):
                continue
            there.add(name)
            for topic, types in self._node.get_subscriber_names_and_types_by_node(name, namespace):
                if topic not in self.publishers and topic not in self.left_out:
                    kind = message_class(types[0])
                    publisher = self._node.create_publisher(kind, topic, LATCHED)
                    self.publishers[topic] = (publisher, kind)
            for service, types in self._node.get_service_names_and_types_by_node(name, namespace):
                if service not in self.clients_of:
                    kind = message_class(types[0])
                    self.clients_of[service] = (self._node.create_client(kind, service), kind)
        return there

    def send(self) -> None:
        """Send one message and one request."""
        publisher, kind = self._rng.choice(list(self.publishers.values()))
        message = random_message(kind, self._rng)
        if kind is JointState:
            message.header.frame_id = _OURS
        publisher.publish(message)
        client, service = self._rng.choice(list(self.clients_of.values()))
        request = random_message(service.Request, self._rng)
        if service is ChangeState and request.transition.id in _ENDS:
            return
        if service is SetBool and "confirm" in client.srv_name:
            request.data = False
        future = client.call_async(request)
        if len(client._pending_requests) > _LONGEST_QUEUE:
            client.remove_pending_request(future)
        self.sent += 2
