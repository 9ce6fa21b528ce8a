"""Nodes that are started by hand steer in any order of their start."""

from __future__ import annotations

import itertools
import os
import random
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from rosbags.rosbag2 import Reader

from needle_bringup.simulation.node_graph import NodeProcess, stop, wait_for
from needle_core.files.installed import find_executable
from needle_core.process.ros_domain import reserve_domain_id

PATIENCE = 120.0  # [s]
STAND_IN = "simulated_operator"
NODES = {
    "sim_rig": ("needle_sim", ("-p", "level:=tip", "-p", "seed:=1")),
    "plane_controller": ("needle_controller", ("-p", "depth:=0.006")),
    "recorder": ("needle_bags", ("-p", "bag:={bag}")),
    STAND_IN: ("needle_bringup", ("-p", "wait_for_recorder:=true")),
}
ORDERS = random.Random(1).sample(list(itertools.permutations(NODES)), 6)


class ManualStart:
    """Starts nodes as a user does in terminals."""

    def __init__(self, folder: Path, domain: int) -> None:
        self.bag = folder / "bag"
        self._folder, self._domain = folder, domain
        self.nodes: dict[str, NodeProcess] = {}

    def start(self, name: str) -> None:
        """Start or restart a node."""
        package, words = NODES[name]
        self.nodes[name] = NodeProcess(
            name,
            [find_executable(package, name), "--ros-args"]
            + [word.format(bag=self.bag) for word in words],
            environment={**os.environ, "ROS_DOMAIN_ID": str(self._domain)},
            log=self._folder / f"{name}.log",
        )

    def has_steered(self) -> bool:
        """Return whether the simulated operator ends after the insertion."""
        return wait_for([self.nodes[STAND_IN]], PATIENCE) == [] and (
            self.nodes[STAND_IN].exit_code == 0
        )


@contextmanager
def hand_at(folder: Path) -> Iterator[ManualStart]:
    with reserve_domain_id() as domain:
        hand = ManualStart(folder, domain)
        try:
            yield hand
        finally:
            stop(hand.nodes.values())


@pytest.mark.parametrize("order", ORDERS, ids=" ".join)
def test_nodes_steer_in_any_order(order: tuple[str, ...], tmp_path: Path) -> None:
    with hand_at(tmp_path) as hand:
        for name in order:
            hand.start(name)
            time.sleep(2.0)
        assert hand.has_steered(), hand.nodes[STAND_IN].tail(5)
        assert stop([hand.nodes["recorder"]]) == []
    with Reader(hand.bag) as reader:
        counts = {topic: info.msgcount for topic, info in reader.topics.items()}
    # 6 steps, and a tip before the first.
    assert counts["/device/result"] >= 6
    assert counts["/needle/tip"] >= 7
