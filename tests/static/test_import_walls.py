"""The contract that keeps ROS in the folders `ros` can fail."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from grimp import ImportGraph

from import_walls import RosFolderContract

CONFIGURATION = Path(__file__).parents[2] / "pyproject.toml"


def broken(importer: str, imported: str) -> list[str]:
    graph = ImportGraph()
    for module in (importer, imported):
        graph.add_module(module, is_squashed="." not in module)
    graph.add_import(importer=importer, imported=imported, line_number=1, line_contents="")
    options: dict[str, Any] = {"packages": ["needle_sim", "needle_core"]}
    contract = RosFolderContract(name="wall", session_options={}, contract_options=options)
    found: list[str] = contract.check(graph, verbose=False).metadata["broken"]
    return found


@pytest.mark.parametrize(
    ("importer", "imported"),
    [
        ("needle_sim.needle.plant", "rclpy"),
        ("needle_sim.needle.any_new_module", "geometry_msgs"),
        ("needle_sim.drives.ros", "rclpy"),
        ("needle_sim.needle.plant", "std_srvs"),
        ("needle_sim.needle.plant", "rcl_interfaces"),
        # A module of the folder would import ROS indirectly.
        ("needle_sim.needle.plant", "needle_sim.ros.conversions"),
        ("needle_sim.needle.plant", "needle_core.ros.base_node"),
    ],
)
def test_a_pure_module_that_imports_ros_breaks_the_contract(importer: str, imported: str) -> None:
    assert broken(importer, imported) == [f"{importer} -> {imported} (line 1)"]


@pytest.mark.parametrize(
    ("importer", "imported"),
    [
        ("needle_sim.ros.sim_rig", "rclpy"),
        ("needle_sim.ros.conversions", "geometry_msgs"),
        ("needle_sim.ros.sim_rig", "needle_core.ros.parameters"),
        ("needle_sim.ros.sim_rig", "needle_sim.ros.conversions"),
        ("needle_sim.needle.plant", "numpy"),
        ("needle_sim.needle.plant", "needle_core.errors"),
    ],
)
def test_other_imports_are_allowed(importer: str, imported: str) -> None:
    assert broken(importer, imported) == []


def test_every_package_has_its_contracts() -> None:
    sources = CONFIGURATION.parent / "ros2_ws" / "src"
    text = CONFIGURATION.read_text("utf-8")
    for package in sources.glob("*/package.xml"):
        # root_packages, the contract on ROS, and at least one on its neighbours
        assert text.count(f'"{package.parent.name}"') >= 3
