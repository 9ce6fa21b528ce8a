"""What the launch files start. `launch` itself is not on PyPI; it adds no rule of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from needle_bringup.simulation.launch_nodes import (
    nodes_beside_rig,
    refuse_misspelt,
    replay_words,
    replayed_nodes,
    simulated_nodes,
)
from needle_core.errors import UserError
from needle_core.files.installed import find_shared
from needle_core.settings.parameter_files import Parameters


def simulated(**arguments: str) -> Parameters:
    default = {
        "level": "camera",
        "seed": "1",
        "controller": "best",
        "simulated_operator": "false",
        "bag": "",
        "can": "/tmp/needle_can",
        "params": "",
    }
    return simulated_nodes({**default, **arguments})


def beside_rig(**arguments: str) -> Parameters:
    calibration = str(find_shared("needle_tracker", "config/calibration.yaml"))
    default = {"calibration": calibration, "drives": "", "bag": "", "params": ""}
    return nodes_beside_rig({**default, **arguments})


def file_of(folder: Path, document: Any) -> str:
    path = folder / "file.yaml"
    path.write_text(yaml.safe_dump(document))
    return str(path)


@pytest.mark.parametrize(("start", "name"), [(beside_rig, "drives"), (beside_rig, "params")])
def test_a_file_that_is_missing_starts_nothing(start: Any, name: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=f"{name}:=.*typo.yaml: no such file"):
        start(**{name: str(tmp_path / "typo.yaml")})


def test_a_calibration_or_simulated_params_that_are_missing_start_nothing(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"calibration:=.*no such file"):
        beside_rig(calibration=str(tmp_path / "typo.yaml"))
    with pytest.raises(UserError, match=r"params:=.*no such file"):
        simulated(params=str(tmp_path / "typo.yaml"))
    with pytest.raises(UserError, match=r"calibration:=.*: a folder, not a file"):
        beside_rig(calibration=str(tmp_path))


def test_drives_that_name_another_node_do_not_start_the_driver_on_its_defaults(
    tmp_path: Path,
) -> None:
    wrong = file_of(tmp_path, {"drive_emulator": {"ros__parameters": {"channel": "x"}}})
    with pytest.raises(UserError, match="'drive_emulator' is not started here, only device_driver"):
        beside_rig(drives=wrong)
    right = file_of(tmp_path, {"device_driver": {"ros__parameters": {"channel": "can7"}}})
    assert beside_rig(drives=right)["device_driver"] == {"channel": "can7"}
    assert "device_driver" not in beside_rig()


@pytest.mark.parametrize("start", [beside_rig, simulated])
def test_a_bag_that_is_there_starts_nothing(start: Any, tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").touch()
    with pytest.raises(UserError, match="holds a bag already"):
        start(bag=str(tmp_path))


@pytest.mark.parametrize("start", [beside_rig, simulated])
def test_a_bag_says_how_it_was_made(start: Any, tmp_path: Path) -> None:
    recorder = start(bag=str(tmp_path / "bag"))["recorder"]
    assert recorder["bag"] == str(tmp_path / "bag")
    assert recorder["run_info"]


def test_a_simulation_has_the_nodes_of_its_level_and_waits_for_a_recorder_only_if_there_is_one(
    tmp_path: Path,
) -> None:
    assert set(simulated(level="tip")) == {"sim_rig", "plane_controller"}
    assert not any("wait_for_recorder" in values for values in simulated(level="drive").values())
    with_all = simulated(
        level="drive", simulated_operator="true", bag=str(tmp_path / "bag"), can="/tmp/c"
    )
    assert with_all["simulated_operator"]["wait_for_recorder"]
    assert with_all["device_driver"]["channel"] == with_all["drive_emulator"]["pty"] == "/tmp/c"


def test_what_an_argument_says_no_file_says(tmp_path: Path) -> None:
    level = file_of(tmp_path, {"sim_rig": {"ros__parameters": {"level": "tip"}}})
    with pytest.raises(UserError, match="level is set by level:="):
        simulated(params=level)
    other = file_of(tmp_path, {"simulated_operator": {"ros__parameters": {"stall_timeout": 1.0}}})
    with pytest.raises(UserError, match="'simulated_operator' is not started here, only sim_rig, "):
        simulated(params=other)
    good = file_of(tmp_path, {"plane_controller": {"ros__parameters": {"depth": 0.05}}})
    assert simulated(params=good)["plane_controller"]["depth"] == 0.05
    assert beside_rig(params=good)["plane_controller"] == {"depth": 0.05}


def test_a_file_of_two_rigs_has_both_namespaces(tmp_path: Path) -> None:
    depths = {f"/rig{n}/plane_controller": {"ros__parameters": {"depth": 0.01 * n}} for n in (1, 2)}
    file = file_of(tmp_path, depths)
    for start in (beside_rig, simulated):
        for namespace in ("rig2", "/rig2/"):
            given = start(params=file, namespace=namespace)["plane_controller"]
            assert given["depth"] == 0.02
        with pytest.raises(
            UserError, match="is for /rig1/plane_controller, this node is /plane_co"
        ):
            start(params=file)
    drives = file_of(tmp_path, {"device_driver": {"ros__parameters": {"channel": "can7"}}})
    with pytest.raises(UserError, match="this node is /rig1/device_driver: write '/rig1/device_d"):
        beside_rig(drives=drives, namespace="rig1")


def test_a_bag_is_played_for_viewers(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").touch()
    arguments = {"bag": str(tmp_path), "rate": "0.5", "start": "2.0", "loop": "true"}
    assert replayed_nodes(arguments) == {"player": {}, "live_view": {}}
    words = replay_words({**arguments, "namespace": "/first"})
    assert words["player"] == [str(tmp_path), "--rate", "0.5", "--start", "2.0", "--loop"]
    # What a rig would obey is played under /replay only.
    assert "target_plane:=/replay/first/target_plane" in words["live_view"]


def test_a_bag_that_is_not_there_is_not_played(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="bag:= is missing"):
        replayed_nodes({"bag": ""})
    with pytest.raises(UserError, match="no bag there"):
        replayed_nodes({"bag": str(tmp_path)})


def test_images_that_are_sent_best_effort_are_heard() -> None:
    assert beside_rig()["stereo_tracker"]["reliable_images"] is False


@pytest.mark.parametrize(("name", "text"), [("seed", "x"), ("seed", "-1")])
def test_a_number_that_cannot_be_meant_starts_nothing(name: str, text: str) -> None:
    with pytest.raises(UserError, match=text):
        simulated(**{name: text})


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("calibraton", "calibration"),
        ("drive", "drives"),
        ("parms", "params"),
        ("Bag", "bag"),
        ("bags", "bag"),
    ],
)
def test_a_misspelt_argument_starts_nothing(name: str, meant: str) -> None:
    declared = ["calibration", "drives", "bag", "params", "namespace"]
    with pytest.raises(UserError, match=f"unknown argument {name}:=, did you mean {meant}:="):
        refuse_misspelt([*declared, name], declared)


def test_the_arguments_of_an_including_launch_file_are_let_pass() -> None:
    declared = ["calibration", "drives", "bag", "params", "namespace"]
    refuse_misspelt([*declared, "ros_namespace", "cameras", "use_sim_time"], declared)
