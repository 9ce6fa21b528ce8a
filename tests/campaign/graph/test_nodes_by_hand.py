"""Nodes started by hand can steer regardless of the order in which they start."""

from __future__ import annotations

import itertools
import random
import time
from pathlib import Path

import pytest
from rosbags.rosbag2 import Reader

from needle_bringup.simulation.node_graph import OPERATOR, NodeGraph, wait_for
from needle_bringup.simulation.rig_configuration import PACKAGES
from needle_core.process.ros_domain import reserve_domain_id
from needle_core.settings.parameter_files import Parameters

TIMEOUT = 120.0  # [s]
PARAMETERS: Parameters = {
    "sim_rig": {"level": "tip", "seed": 1},
    "plane_controller": {"depth": 0.006},
    "recorder": {"bag": ""},
    OPERATOR: {"wait_for_recorder": True},
}
ORDERS = random.Random(1).sample(list(itertools.permutations(PARAMETERS)), 6)


@pytest.mark.parametrize("order", ORDERS, ids=" ".join)
def test_nodes_steer_in_any_order(order: tuple[str, ...], tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    parameters = {**PARAMETERS, "recorder": {"bag": str(bag)}}
    with reserve_domain_id() as domain:
        graph = NodeGraph(tmp_path, parameters, ROS_DOMAIN_ID=str(domain))
        try:
            for name in order:
                graph.start(PACKAGES[name], name)
                time.sleep(2.0)
            operator = graph.nodes[OPERATOR]
            assert wait_for([operator], TIMEOUT) == []
            assert operator.exit_code == 0, operator.tail(5)
        finally:
            graph.stop()
    assert graph.nodes["recorder"].exit_code == 0
    with Reader(bag) as reader:
        counts = {topic: info.msgcount for topic, info in reader.topics.items()}
    # 6 steps, and a tip before the first.
    assert counts["/device/result"] >= 6
    assert counts["/needle/tip"] >= 7
