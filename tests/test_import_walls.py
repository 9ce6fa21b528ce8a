"""The contract that keeps ROS in the shell modules must be able to fail."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from grimp import ImportGraph

from import_walls import RosShellContract

CONFIGURATION = Path(__file__).parents[1] / "pyproject.toml"


def broken(importer: str, imported: str) -> list[str]:
    graph = ImportGraph()
    for module in (importer, imported):
        graph.add_module(module, is_squashed="." not in module)
    graph.add_import(importer=importer, imported=imported, line_number=1, line_contents="")
    options: dict[str, Any] = {"packages": ["needle_sim", "needle_common"]}
    contract = RosShellContract(name="wall", session_options={}, contract_options=options)
    found: list[str] = contract.check(graph, verbose=False).metadata["broken"]
    return found


@pytest.mark.parametrize(
    ("importer", "imported"),
    [
        ("needle_sim.plant", "rclpy"),
        ("needle_sim.any_new_module", "geometry_msgs"),
        ("needle_sim.plant", "std_srvs"),
        ("needle_sim.plant", "rcl_interfaces"),
        # Through a shell module, ROS would be imported all the same.
        ("needle_sim.plant", "needle_sim.conversions"),
        ("needle_sim.plant", "needle_common.base_node"),
    ],
)
def test_a_pure_module_that_reaches_for_ros_breaks_the_wall(importer: str, imported: str) -> None:
    assert broken(importer, imported) == [f"{importer} -> {imported} (line 1)"]


@pytest.mark.parametrize(
    ("importer", "imported"),
    [
        ("needle_sim.sim_rig_node", "rclpy"),
        ("needle_sim.conversions", "geometry_msgs"),
        ("needle_sim.parameters", "needle_common.parameters"),
        ("needle_sim.sim_rig_node", "needle_sim.conversions"),
        ("needle_sim.plant", "numpy"),
        ("needle_sim.plant", "needle_common.errors"),
    ],
)
def test_the_rest_is_allowed(importer: str, imported: str) -> None:
    assert broken(importer, imported) == []


def test_every_package_is_behind_the_walls() -> None:
    sources = CONFIGURATION.parent / "ros2_ws" / "src"
    text = CONFIGURATION.read_text("utf-8")
    for package in sources.glob("*/package.xml"):
        # root_packages, the contract on ROS, and at least one on its neighbours
        assert text.count(f'"{package.parent.name}"') >= 3
