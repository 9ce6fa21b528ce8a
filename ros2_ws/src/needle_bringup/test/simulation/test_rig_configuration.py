"""Node parameters from a command line agree on one needle; contradictions are reported."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import yaml

from needle_bags.live.live_view import LiveViewParameters
from needle_bringup.simulation.rig_configuration import (
    CURVATURE,
    NODES,
    PACKAGES,
    PRE_BEND,
    SHARED,
    command_line_parameters,
    contradictions,
    merge,
    needle_parameters,
    nodes_of,
    refuse_reserved,
)
from needle_bringup.simulation.simulate_options import SimulateOptions, parse
from needle_controller.presets.steering_settings import SteeringSettings
from needle_core.errors import UserError
from needle_core.settings import parameter_files
from needle_core.settings.parameter_files import Parameters
from needle_device_driver.parameters import DeviceDriverParameters
from needle_sim.needle.needle_shape import NeedleShape
from needle_sim.sim_rig_parameters import SimRigParameters
from needle_tracker.tracker_parameters import StereoTrackerParameters

STRAIGHT = NeedleShape(bend_angle=0.0, lean=0.0)
CLASSES: dict[str, type[Any]] = {
    "device_driver": DeviceDriverParameters,
    "live_view": LiveViewParameters,
    "sim_rig": SimRigParameters,
    "stereo_tracker": StereoTrackerParameters,
    "plane_controller": SteeringSettings,
}


def nodes_for(command_line: str = "") -> Parameters:
    return command_line_parameters(parse(command_line.split()), Path("bag"))


def test_the_command_line_is_converted_to_si_and_to_an_offset_of_the_plane() -> None:
    found = nodes_for("--initial -3,2,15 --depth-mm 80 --play-deg 9 --lag-mm 2 --target 10,-5,100")
    rig, controller = found["sim_rig"], found["plane_controller"]
    assert controller["target_offset"] == pytest.approx(0.003)
    assert controller["depth"] == pytest.approx(0.08)
    assert controller["target_point"] == pytest.approx([0.010, -0.005, 0.100])
    assert rig["initial_pitch"] == pytest.approx(math.radians(2.0))
    assert rig["initial_roll"] == pytest.approx(math.radians(15.0))
    assert rig["torsion_play"] == pytest.approx(math.radians(9.0))
    assert rig["torsion_lag"] == pytest.approx(0.002)
    own = nodes_for("--target 0,0,90 --planner mine --estimator its --law theirs --seed 7")
    for name, value in {"planner": "mine", "estimator": "its", "law": "theirs", "seed": 7}.items():
        assert own["plane_controller"][name] == value


def test_obstacles_are_read_into_numbers(tmp_path: Path) -> None:
    path = tmp_path / "obstacles.yaml"
    path.write_text("frame: rig\nspheres: [{center: [0.0, 0.001, 0.05], radius: 0.004}]\n", "utf-8")
    found = nodes_for(f"--target 0,0,100 --obstacles {path}")["plane_controller"]["obstacles"]
    assert found == [0.0, 0.001, 0.05, 0.0, 0.001, 0.05, 0.004]


def test_only_the_nodes_of_the_level_run() -> None:
    everywhere = {"recorder", "sim_rig", "plane_controller", "simulated_operator"}
    camera = everywhere | {"stereo_tracker"}
    drive = camera | {"drive_emulator", "device_driver"}
    for level, nodes in (("tip", everywhere), ("camera", camera), ("drive", drive)):
        assert set(nodes_of(SimulateOptions(level=level))) == nodes
    assert set(PACKAGES) <= set(parameter_files.NODES)


def test_the_driver_finds_its_drives_in_a_graph() -> None:
    found = nodes_for("--level drive --graph")
    assert found["device_driver"]["channel"] == found["drive_emulator"]["pty"]
    assert found["simulated_operator"]["wait_for_recorder"]
    # Processes that share the cores wait for each other longer.
    assert found["device_driver"]["watchdog"] > 0.1
    two = nodes_for("--level drive --graph --drives galil,zaber")
    driver, port = two["device_driver"], two["drive_emulator"]["listen"]
    assert (driver["insertion_drive"], driver["galil_address"]) == ("galil", f"127.0.0.1:{port}")
    assert (driver["rotation_drive"], driver["zaber_address"]) == ("zaber", f"127.0.0.1:{port + 1}")


def test_the_controller_is_configured_for_the_sensor_of_its_level() -> None:
    tip = nodes_for("--level tip --noise-mm 0.5")["plane_controller"]
    assert (tip["tip_covariance"], tip["tip_noise"]) == ("configured", "bounded")
    assert tip["tip_noise_bound"] == pytest.approx(0.0005)
    assert tip["measurement_std"] == pytest.approx(0.0005 / math.sqrt(3.0))
    assert nodes_for("--level tip --noise-mm 0")["plane_controller"]["tip_noise_bound"] > 0.0
    assert "tip_noise" not in nodes_for()["plane_controller"]


def test_later_layers_replace_single_parameters() -> None:
    layers: list[Parameters] = [{"sim_rig": {"level": "tip", "seed": 2}}, {"sim_rig": {"seed": 3}}]
    merged = merge(*layers, {"console": {}})
    assert merged == {"sim_rig": {"level": "tip", "seed": 3}, "console": {}}


def test_a_file_must_not_conflict_with_the_command_line() -> None:
    path, options = Path("p.yaml"), parse(["--level", "tip"])
    for node, name in (("plane_controller", "depth"), ("simulated_operator", "wait_for_recorder")):
        with pytest.raises(UserError, match=f"{node}: {name} cannot be in the file"):
            refuse_reserved(path, {node: {name: 0.1}}, options)
    refuse_reserved(path, {"plane_controller": {"curvature": 8.0}}, options)


def test_every_yaml_of_the_package_parses() -> None:
    files = list((Path(__file__).parents[2] / "config").glob("*.yaml"))
    assert all(yaml.safe_load(path.read_text()) for path in files)


def test_the_defaults_of_a_needle_are_those_of_the_nodes() -> None:
    for shared in SHARED:
        for node, name in shared.names.items():
            default = getattr(CLASSES[node](), name)
            if isinstance(shared.default, float):
                assert default == pytest.approx(shared.default, abs=2e-4), (node, name)
            else:
                assert default == shared.default
    assert SimRigParameters().pre_bend == pytest.approx(PRE_BEND)
    assert SimulateOptions().depth_mm == pytest.approx(SteeringSettings().depth * 1e3)
    assert contradictions({}, NODES) == []


def test_the_options_of_a_needle_set_all_nodes() -> None:
    given = nodes_for("--curvature 5 --diameter-mm 1.2 --pre-bend-deg 6 --insertion continuous")
    nodes = {
        node: kind(**{k: v for k, v in given[node].items() if k in kind.__dataclass_fields__})
        for node, kind in CLASSES.items()
        if node in given
    }
    for shared in SHARED:
        values = {
            getattr(nodes[node], name) for node, name in shared.names.items() if node in given
        }
        assert len(values) <= 1, shared
    rig, tracker = nodes["sim_rig"], nodes["stereo_tracker"]
    assert (rig.curvature, rig.needle_diameter) == (5.0, pytest.approx(0.0012))
    assert rig.pre_bend == pytest.approx(math.radians(6.0))
    assert rig.pre_bend_lean < rig.pre_bend
    assert rig.camera_rate > 10.0
    assert tracker.max_curvature > 5.0
    assert tracker.tip_lean > rig.pre_bend_lean
    assert contradictions(given, NODES) == []
    straight = needle_parameters(None, None, 0.0)["sim_rig"]
    assert dataclasses.replace(SimRigParameters(), **straight).needle == STRAIGHT


def test_contradictions_are_reported() -> None:
    for node, name, value, cause in (
        ("sim_rig", "curvature", 6.0, "sim_rig has curvature 6 1/m, plane_controller has"),
        ("plane_controller", "curvature", 6.0, "--curvature sets it in all nodes"),
        ("stereo_tracker", "needle_width", 0.001, "needle_width 0.001 m"),
        ("sim_rig", "calibration_file", "mine.yaml", "stereo_tracker has calibration_file ''"),
    ):
        (line,) = contradictions(merge(nodes_for(), {node: {name: value}}), NODES)
        assert cause in line
    curved: Parameters = {node: {"curvature": 12.0} for node in ("sim_rig", "plane_controller")}
    (line,) = contradictions(curved, NODES)
    assert line == "sim_rig has curvature 12, but stereo_tracker expects max_curvature 9"
    assert contradictions(curved, ("sim_rig", "plane_controller")) == []
    assert contradictions({"sim_rig": {"curvature": CURVATURE * (1 + 1e-6)}}, NODES) == []
