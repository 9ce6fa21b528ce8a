"""Clocks of other computers, asked over a real graph; this computer's is shifted."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState

from needle_common.diagnostics import Diagnostic, Level
from needle_common.process.clock_offset import ClockOffset
from needle_common.process.reach import DISCOVERY_RANGE
from needle_common.process.ros_domain import own_domain
from needle_common.ros.base_node import DiagnosticsPublisher, executor_of
from needle_common.ros.partner_clocks import PART, PartnerClocks, judge

LIMIT = 30.0


class Health(DiagnosticsPublisher):
    """Remembers what was set."""

    def __init__(self, node: Node) -> None:
        super().__init__(node)
        self.parts: dict[str, Diagnostic] = {}

    def set(self, part: str, diagnostic: Diagnostic) -> None:
        self.parts[part] = diagnostic


@pytest.fixture
def nodes() -> Iterator[tuple[Node, Node]]:
    """Make one node that hears joints, and one that says them."""
    with own_domain() as domain:
        context = Context()
        rclpy.init(context=context, domain_id=domain)
        here, there = (rclpy.create_node(name, context=context) for name in ("here", "there"))
        there.create_publisher(JointState, "joint_states", 10)
        yield here, there
        for node in (here, there):
            node.destroy_node()
        rclpy.shutdown(context=context)


@pytest.mark.parametrize("shift", [-0.2, 0.2])
def test_a_clock_that_differs_is_told_with_its_amount(
    nodes: tuple[Node, Node], shift: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(DISCOVERY_RANGE, "SUBNET")
    here, there = nodes
    health = Health(here)
    PartnerClocks(here, health, ("joint_states",), lambda: time.time_ns() - round(shift * 1e9))
    other = SingleThreadedExecutor(context=there.context)
    other.add_node(there)
    deadline = time.monotonic() + LIMIT
    with executor_of(here) as executor:
        while health.parts.get(PART, Diagnostic(Level.OK, "")).level is Level.OK:
            executor.spin_once(timeout_sec=0.01)
            other.spin_once(timeout_sec=0.01)
            assert time.monotonic() < deadline, health.parts
    other.shutdown()
    found = health.parts[PART]
    ahead, within = (float(found.values[f"/there {what}_s"]) for what in ("ahead", "within"))
    assert abs(ahead - shift) <= within + 1e-3
    assert ("ahead of" if shift > 0 else "behind") in found.message


def test_on_one_machine_nobody_is_asked(nodes: tuple[Node, Node]) -> None:
    here, _ = nodes
    health = Health(here)
    PartnerClocks(here, health, ("joint_states",))
    assert health.parts[PART].message == "one clock"


def test_what_cannot_be_told_is_no_warning() -> None:
    assert judge({"/a": ClockOffset(0.2, 0.195)}).level is Level.OK
    assert judge({"/a": ClockOffset(-0.2, 0.1)}).level is Level.WARN
    assert "no answer yet from /b" in judge({"/a": ClockOffset(0.0, 0.001), "/b": None}).message
