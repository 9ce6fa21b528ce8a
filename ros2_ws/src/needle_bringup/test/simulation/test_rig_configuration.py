import math
from pathlib import Path

import pytest
import yaml

from needle_bringup.simulation.rig_configuration import (
    PACKAGES,
    command_line_parameters,
    merge,
    nodes_of,
    refuse_reserved,
    write_parameters,
)
from needle_bringup.simulation.simulate_options import SimulateOptions
from needle_controller.presets.steering_settings import SteeringSettings
from needle_core.errors import UserError
from needle_core.settings.parameter_files import NODES, read_parameters


def test_the_start_is_converted_to_si_and_to_an_offset_of_the_plane() -> None:
    options = SimulateOptions(initial_x_mm=-3.0, initial_pitch_deg=2.0, depth_mm=80.0)
    parameters = command_line_parameters(options, Path("bags/x"))
    assert parameters["plane_controller"]["target_offset"] == pytest.approx(0.003)
    assert parameters["plane_controller"]["depth"] == pytest.approx(0.08)
    assert parameters["sim_rig"]["initial_pitch"] == pytest.approx(math.radians(2.0))


def test_a_target_point_is_one_in_metres() -> None:
    found = command_line_parameters(SimulateOptions(target_mm=(10.0, -5.0, 100.0)), Path("bag"))
    assert found["plane_controller"]["target_point"] == pytest.approx([0.010, -0.005, 0.100])
    assert (
        "target_point"
        not in command_line_parameters(SimulateOptions(), Path("b"))["plane_controller"]
    )


def test_obstacles_are_read_into_numbers(tmp_path: Path) -> None:
    path = tmp_path / "obstacles.yaml"
    path.write_text(
        "frame: rig\nspheres: [{center: [0.0, 0.001, 0.05], radius: 0.004}]\n", encoding="utf-8"
    )
    options = SimulateOptions(target_mm=(0.0, 0.0, 100.0), obstacles=path)
    found = command_line_parameters(options, Path("bag"))["plane_controller"]["obstacles"]
    assert found == [0.0, 0.001, 0.05, 0.0, 0.001, 0.05, 0.004]
    path.write_text("frame: map\n", encoding="utf-8")
    with pytest.raises(UserError, match="frame 'map'"):
        command_line_parameters(options, Path("bag"))


def test_only_the_nodes_of_the_level_run() -> None:
    everywhere = {"recorder", "sim_rig", "plane_controller", "simulated_operator"}
    assert set(nodes_of(SimulateOptions(level="tip"))) == everywhere
    assert set(nodes_of(SimulateOptions(level="camera"))) == everywhere | {"stereo_tracker"}
    drives = {"drive_emulator", "device_driver"}
    assert set(nodes_of(SimulateOptions(level="drive"))) == everywhere | {"stereo_tracker"} | drives


def test_driver_and_drives_meet() -> None:
    parameters = command_line_parameters(SimulateOptions(level="drive"), Path("bags/x"))
    assert parameters["device_driver"]["channel"] == parameters["drive_emulator"]["pty"]


def test_later_layers_win_one_parameter_at_a_time() -> None:
    merged = merge({"a": {"x": 1, "y": 2}}, {"a": {"y": 3}, "b": {}})
    assert merged == {"a": {"x": 1, "y": 3}, "b": {}}


def test_a_written_file_reads_back(tmp_path: Path) -> None:
    parameters = {"sim_rig": {"level": "tip", "curvature": 1e-5, "flag": True}}
    write_parameters(tmp_path / "p.yaml", parameters)
    assert read_parameters(tmp_path / "p.yaml", NODES) == parameters


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("controller: {ros__parameters: {x: 1}}", "unknown node 'controller'"),
        ("joy_node: {ros__parameters: {x: 1}}", "'joy_node' is not started here"),
        ("/rig1/sim_rig: {ros__parameters: {x: 1}}", "this node is /sim_rig"),
        ("[1, 2", "not YAML"),
        ("just text", "not a ROS parameter file"),
        ("", "not a ROS parameter file"),
    ],
)
def test_a_bad_file_is_named_in_one_line(tmp_path: Path, text: str, named: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(UserError) as caught:
        read_parameters(path, NODES)
    assert named in str(caught.value)
    assert str(path) in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_a_file_may_not_contradict_the_command_line() -> None:
    path = Path("p.yaml")
    options = SimulateOptions(level="tip", noise_mm=1.0)
    with pytest.raises(UserError, match="--depth-mm"):
        refuse_reserved(path, {"plane_controller": {"depth": 0.1}}, options)
    with pytest.raises(UserError, match="recorder: topics does not go into the file: simulate wa"):
        refuse_reserved(path, {"recorder": {"topics": ["/needle/tip"]}}, options)
    refuse_reserved(path, {"plane_controller": {"curvature": 8.0}}, options)


def test_every_yaml_of_the_package_parses() -> None:
    folder = Path(__file__).parents[2] / "config"
    for path in folder.glob("*.yaml"):
        assert yaml.safe_load(path.read_text())


def test_the_controller_knows_the_sensor_of_its_level() -> None:
    tip = command_line_parameters(SimulateOptions(level="tip", noise_mm=0.5), Path("bag"))
    assert tip["plane_controller"]["tip_covariance"] == "configured"
    assert tip["plane_controller"]["tip_noise"] == "bounded"
    assert tip["plane_controller"]["tip_noise_bound"] == pytest.approx(0.0005)
    exact = command_line_parameters(SimulateOptions(level="tip", noise_mm=0.0), Path("bag"))
    assert exact["plane_controller"]["tip_noise_bound"] > 0.0
    camera = command_line_parameters(SimulateOptions(), Path("bag"))
    assert "tip_noise" not in camera["plane_controller"]


def test_by_hand_is_the_rig_that_simulate_runs() -> None:
    # What simulate tells the nodes beyond their defaults is said on the command line, or concerns
    # recording and the emulated adapter: nothing of it describes the rig.
    set_by_simulate = command_line_parameters(SimulateOptions(level="drive"), Path("bag"))
    of_run = {"level", "seed", "preset"}
    of_needle = {"initial_pitch", "initial_roll", "torsion_play", "torsion_lag"}
    told = {node: set(values) - of_run for node, values in set_by_simulate.items()}
    assert told["sim_rig"] == of_needle
    assert told["plane_controller"] == {"depth", "target_offset"}
    assert told["stereo_tracker"] == set()
    defaults = SteeringSettings()
    assert defaults.tip_covariance == "from_tip_pose"
    assert SimulateOptions().depth_mm == pytest.approx(defaults.depth * 1e3)


def test_the_nodes_of_a_run_are_known_by_hand_too() -> None:
    assert set(PACKAGES) <= set(NODES)
