"""Nodes started by the launch files. `launch` itself is not on PyPI; it adds no rule."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from needle_bringup.simulation.launch_nodes import (
    nodes_alongside_rig,
    refuse_misspelt,
    replay_arguments,
    replayed_nodes,
    simulated_nodes,
)
from needle_core.errors import UserError
from needle_core.files.installed import find_shared_file
from needle_core.settings.parameter_files import Parameters


def simulated(**arguments: str) -> Parameters:
    default = {"level": "camera", "seed": "1", "controller": "best", "simulated_operator": "false"}
    return simulated_nodes({"bag": "", "params": "", "can": "/tmp/c", **default, **arguments})


def alongside_rig(**arguments: str) -> Parameters:
    calibration = str(find_shared_file("needle_tracker", "config/calibration.yaml"))
    default = dict.fromkeys(("registration", "drives", "bag", "params"), "")
    return nodes_alongside_rig({**default, "calibration": calibration, **arguments})


def file_of(folder: Path, node: str, **values: Any) -> str:
    path = folder / f"{node.replace('/', '_')}.yaml"
    path.write_text(yaml.safe_dump({node: {"ros__parameters": values}}))
    return str(path)


def test_invalid_launch_arguments_start_nothing(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").touch()
    bag, typo = str(tmp_path), str(tmp_path / "typo.yaml")
    emulator = file_of(tmp_path, "drive_emulator", channel="x")
    operator = file_of(tmp_path, "simulated_operator", wait_for_recorder=True)
    for start, arguments, cause in (
        (alongside_rig, {"drives": typo}, "drives:=.*typo.yaml: no such file"),
        (alongside_rig, {"params": typo}, "params:=.*typo.yaml: no such file"),
        (alongside_rig, {"calibration": bag}, "calibration:=.*: a folder, not a file"),
        (alongside_rig, {"registration": typo}, "registration:=.*typo.yaml: no such file"),
        (alongside_rig, {"bag": bag}, "already contains a bag"),
        (simulated, {"seed": "-1"}, "--seed = -1"),
        # A driver without configuration would run on its defaults.
        (alongside_rig, {"drives": emulator}, "'drive_emulator' is not started here, only device"),
        (simulated, {"params": operator}, "'simulated_operator' is not started here, only sim_rig"),
        (
            simulated,
            {"params": file_of(tmp_path, "sim_rig", level="tip")},
            "sim_rig: level is set by level:=",
        ),
    ):
        with pytest.raises(UserError, match=cause):
            start(**arguments)


def test_a_rig_has_the_nodes_of_its_files(tmp_path: Path) -> None:
    plain = alongside_rig()
    assert set(plain) == {"stereo_tracker", "plane_controller"}
    # Best-effort images are received.
    assert plain["stereo_tracker"]["reliable_images"] is False
    registration = file_of(tmp_path, "registration")
    tracked = alongside_rig(registration=registration)
    assert tracked == {"plane_controller": {}, "tracked_tip": {"registration_file": registration}}
    drives = file_of(tmp_path, "device_driver", channel="can7")
    assert alongside_rig(drives=drives)["device_driver"] == {"channel": "can7"}
    depth = file_of(tmp_path, "plane_controller", depth=0.05)
    assert alongside_rig(params=depth)["plane_controller"] == {"depth": 0.05}
    assert simulated(params=depth)["plane_controller"]["depth"] == 0.05
    with pytest.raises(UserError, match="this node is /rig1/device_driver: write '/rig1/device_d"):
        alongside_rig(drives=drives, namespace="rig1")


def test_a_bag_contains_its_launch_arguments(tmp_path: Path) -> None:
    for start in (alongside_rig, simulated):
        recorder = start(bag=str(tmp_path / "bag"))["recorder"]
        assert recorder["bag"] == str(tmp_path / "bag")
        assert recorder["run_info"]


def test_a_simulation_has_the_nodes_of_its_level_and_waits_for_a_recorder_only_if_there_is_one(
    tmp_path: Path,
) -> None:
    assert set(simulated(level="tip")) == {"sim_rig", "plane_controller"}
    alone = simulated(level="drive", simulated_operator="true")
    assert "wait_for_recorder" not in alone["simulated_operator"]
    whole = simulated(level="drive", simulated_operator="true", bag=str(tmp_path / "bag"))
    assert whole["simulated_operator"]["wait_for_recorder"]
    assert whole["device_driver"]["channel"] == whole["drive_emulator"]["pty"] == "/tmp/c"


def test_a_file_of_two_rigs_has_both_namespaces(tmp_path: Path) -> None:
    depths = {f"/rig{n}/plane_controller": {"ros__parameters": {"depth": 0.01 * n}} for n in (1, 2)}
    file = tmp_path / "two.yaml"
    file.write_text(yaml.safe_dump(depths))
    for start in (alongside_rig, simulated):
        given = start(params=str(file), namespace="rig2")
        assert given["plane_controller"]["depth"] == 0.02
        with pytest.raises(UserError, match="is for /rig1/plane_controller, this node is /plane_"):
            start(params=str(file))


def test_an_existing_bag_is_played_for_viewers(tmp_path: Path) -> None:
    for bag, cause in (("", "bag:= is missing"), (str(tmp_path), "no bag there")):
        with pytest.raises(UserError, match=cause):
            replayed_nodes({"bag": bag})
    (tmp_path / "metadata.yaml").touch()
    arguments = {"bag": str(tmp_path), "rate": "0.5", "start": "2.0", "loop": "true"}
    assert replayed_nodes(arguments) == {"player": {}, "live_view": {}}
    by_node = replay_arguments({**arguments, "namespace": "/first"})
    assert by_node["player"] == [str(tmp_path), "--rate", "0.5", "--start", "2.0", "--loop"]
    # Topics that control a rig are played only under /replay.
    assert "target_plane:=/replay/first/target_plane" in by_node["live_view"]


def test_a_misspelt_argument_is_named() -> None:
    declared = ["calibration", "drives", "bag", "params", "namespace"]
    for name, meant in (("calibraton", "calibration"), ("Bag", "bag"), ("bags", "bag")):
        with pytest.raises(UserError, match=f"unknown argument {name}:=, did you mean {meant}:="):
            refuse_misspelt([*declared, name], declared)
    refuse_misspelt([*declared, "ros_namespace", "cameras", "use_sim_time"], declared)
