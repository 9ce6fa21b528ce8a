"""`rerun` on the committed bag: unchanged as it is, red with a gain or a sign changed."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rclpy.parameter import Parameter
from rosbags.typesys import Stores, get_typestore

from needle_analysis.rerun.rerun_bag import TABLE
from needle_analysis.ros import rerun as rerun_node
from needle_bags.format.bag_copy import BagCopy, standard_text, standard_topic
from needle_bags.reading.bag_files import read_contents
from needle_bags.reading.bag_order import raw_as_sent
from needle_bags.reading.bag_reader import read_run
from needle_controller.presets.steering_settings import SteeringSettings
from needle_tracker.optics.calibration import StereoCalibration, parse_calibration

STORE = get_typestore(Stores.ROS2_JAZZY)
EVENT = "rcl_interfaces/msg/ParameterEvent"
BAG = Path(__file__).resolve().parents[5] / "bags" / "regression"

Capture = pytest.CaptureFixture[str]


def rerun(*arguments: object) -> int:
    return rerun_node.main([str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def paper_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The committed bag as preset paper would have it."""
    bag = tmp_path_factory.mktemp("rerun") / "paper"
    assert rerun(BAG, "--preset", "paper", "--output", bag) == 1
    return bag


def changed_fields(result: Path) -> set[str]:
    values: dict[str, Any] = json.loads(result.read_text())
    return {
        key.removesuffix("_differing")
        for key, v in values.items()
        if key.endswith("_differing") and v
    }


def test_todays_code_does_what_it_did(capsys: Capture) -> None:
    assert rerun(BAG) == 0, f"{capsys.readouterr().out}\nmeant? scripts/renew_regression_bag"
    printed = capsys.readouterr().out
    assert "6 image pairs through stereo_tracker, 121 tips through plane_controller" in printed
    assert "UNCHANGED" in printed


@pytest.mark.parametrize(
    ("parameter", "field"),
    [
        ("curvature", "needle_control_input_u"),
        ("target_offset", "needle_reduced_state_r1"),
        ("step_length", "device_joint_trajectory_insertion"),
    ],
)
def test_a_hundredth_is_seen(tmp_path: Path, parameter: str, field: str) -> None:
    file, result = tmp_path / "changed.yaml", tmp_path / "result.json"
    value = 1.01 * read_run(BAG).parameter("plane_controller", parameter)
    file.write_text(f"plane_controller: {{ros__parameters: {{{parameter}: {value}}}}}")
    assert rerun(BAG, "--params", file, "--json", result) == 1
    assert field in changed_fields(result)


def test_a_sign_in_the_projection_is_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    def mirrored(document: Any) -> StereoCalibration:
        calibration = parse_calibration(document)
        matrix = calibration.left.camera_matrix * np.array([[1, 1, 1], [1, -1, 1], [1, 1, 1]])
        left = dataclasses.replace(calibration.left, camera_matrix=matrix)
        return dataclasses.replace(calibration, left=left)

    monkeypatch.setattr("needle_analysis.ros.rerun.parse_calibration", mirrored)
    assert rerun(BAG) == 1
    assert "needle/tip: 6 recorded but not today (at 30.0 mm" in capsys.readouterr().out


def test_code_that_breaks_is_told_from_code_that_changed(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    def mistaken(*_: object) -> None:
        raise ValueError("behind the camera")

    monkeypatch.setattr("needle_analysis.ros.tracker_rerun.TrackerStage.take", mistaken)
    assert rerun(BAG) == 3
    assert "internal error, please report it: ValueError: behind" in capsys.readouterr().err


def test_another_preset_is_a_run_of_its_own(
    paper_bag: Path, tmp_path: Path, capsys: Capture
) -> None:
    assert rerun(paper_bag) == 0
    assert "(paper)" in capsys.readouterr().out
    result = tmp_path / "result.json"
    assert rerun(BAG, "--preset", "paper", "--json", result) == 1
    changed = changed_fields(result)
    assert "needle_estimate_position" in changed
    # Tips are measured anew: the same but for rounding, which is the processor's.
    assert not {name for name in changed if name.startswith("needle_tip")}
    # Beyond the outputs it is the same bag.
    before, after = read_contents(BAG), read_contents(paper_bag)
    assert before.counts == after.counts
    for topic in ("/joint_states", "/device/status", "/sim/tip_pose"):
        kept = [
            [(m.log_time, m.data) for m in raw_as_sent(bag, topic.__eq__, lambda _: False)]
            for bag in (BAG, paper_bag)
        ]
        assert kept[0] == kept[1]
    lines = (paper_bag / TABLE).read_text().splitlines()
    assert len(lines) == 122
    assert lines[0].split()[:3] == ["insertion_mm", "tip_x_mm", "tip_y_mm"]


def test_a_gain_that_is_off_by_a_hundredth_is_seen(
    paper_bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    designed = SteeringSettings.gains

    def off(settings: SteeringSettings) -> Any:
        gains = designed(settings)
        feedback = np.array(gains.feedback, copy=True)
        feedback.flat[0] *= 1.01
        return dataclasses.replace(gains, feedback=feedback)

    monkeypatch.setattr(SteeringSettings, "gains", off)
    result = tmp_path / "result.json"
    assert rerun(paper_bag, "--json", result) == 1
    assert "needle_control_input_v" in changed_fields(result)


def test_the_committed_table_is_the_committed_bags() -> None:
    """The table that people read in a diff belongs to the bag beside it."""
    rows = (BAG / TABLE).read_text().splitlines()[1:]
    assert len(rows) == read_contents(BAG).counts["/needle/estimate"]


def test_parameters_as_nodes_announced_them_do_as_well(tmp_path: Path) -> None:
    """What ROS 2's own recorder leaves: no custom data, but /parameter_events."""
    contents, values = read_contents(BAG), read_run(BAG).parameters
    copy = BagCopy(tmp_path / "bag", "jazzy", {"calibration": contents.custom_data["calibration"]})
    topic = standard_topic("/parameter_events", EVENT)
    for node, parameters in values.items():
        copy.put(topic, event(node, parameters), contents.start, contents.start)
    for m in raw_as_sent(BAG, lambda _: True, lambda _: False):
        copy.put(contents.topics[m.topic], m.data, m.log_time, m.time)
    copy.close()
    assert rerun(tmp_path / "bag") == 0


def test_the_calibration_that_the_tracker_told_is_used(tmp_path: Path, capsys: Capture) -> None:
    """It says it on a topic of its own: nobody has to tell the recorder."""
    contents, text = read_contents(BAG), read_run(BAG).calibration
    custom = {"parameters": contents.custom_data["parameters"], "calibration": "left: {}"}
    copy = BagCopy(tmp_path / "bag", "jazzy", custom)
    topic = standard_topic("/stereo_tracker/calibration", "std_msgs/msg/String")
    copy.put(topic, standard_text(text), contents.start, contents.start)
    for m in raw_as_sent(BAG, lambda _: True, lambda _: False):
        copy.put(contents.topics[m.topic], m.data, m.log_time, m.time)
    copy.close()
    assert rerun(tmp_path / "bag") == 0
    other = yaml.safe_load(text)
    other["phantom"]["refractive_index"] += 0.01
    (tmp_path / "other.yaml").write_text(yaml.safe_dump(other))
    values = f"{{ros__parameters: {{calibration_file: {tmp_path}/other.yaml}}}}"
    (tmp_path / "given.yaml").write_text(f"stereo_tracker: {values}")
    again = tmp_path / "again"
    given = ("--params", tmp_path / "given.yaml", "--output", again)
    assert rerun(tmp_path / "bag", *given) == 1
    # What was used is in the copy, which runs again unchanged.
    assert yaml.safe_load(read_run(again).calibration) == other
    capsys.readouterr()


def event(node: str, parameters: dict[str, Any]) -> bytes:
    """A node's ParameterEvent of its start, as CDR."""
    types = STORE.types
    kinds = {"byte": np.uint8, "bool": np.bool_, "integer": np.int64, "double": np.float64}

    def value(content: Any) -> Any:
        message = Parameter("", value=content).get_parameter_value()
        fields = {name: getattr(message, name) for name in message.get_fields_and_field_types()}
        for kind, numbers in kinds.items():
            # rclpy has lists where rosbags wants arrays.
            name = f"{kind}_array_value"
            fields[name] = np.array(fields[name], numbers)
        return types["rcl_interfaces/msg/ParameterValue"](**fields)

    parameter = types["rcl_interfaces/msg/Parameter"]
    new = [parameter(name, value(content)) for name, content in parameters.items()]
    stamp = types["builtin_interfaces/msg/Time"](1, 0)
    return bytes(STORE.serialize_cdr(types[EVENT](stamp, node, new, [], []), EVENT))


BAD: list[tuple[list[str], str]] = [
    (["--preset", "bset"], "--preset 'bset' is not one of"),
    (["--json", "/nowhere/at/all.json"], "its folder must exist"),
    (["--params", "/nowhere.yaml"], "/nowhere.yaml"),
    (["--output", str(BAG)], "holds a bag already"),
    (["--presets", "best"], "see --help"),
]


@pytest.mark.parametrize(("arguments", "words"), BAD)
def test_bad_input_is_one_line(arguments: list[str], words: str, capsys: Capture) -> None:
    assert rerun(BAG, *arguments) == 2
    printed = capsys.readouterr().err
    assert words in printed
    assert printed.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("curvatur: 8.0", "has no parameter curvatur"),
        ("curvature: -8.0", "curvature = -8"),
        ("curvature: high", "curvature"),
    ],
)
def test_bad_parameters_are_one_line(
    tmp_path: Path, text: str, words: str, capsys: Capture
) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text(f"plane_controller: {{ros__parameters: {{{text}}}}}")
    assert rerun(BAG, "--params", file) == 2
    printed = capsys.readouterr().err.splitlines()
    # Of what the bag's nodes had and today's do not have it warns first.
    said = [line for line in printed if "no longer has" not in line]
    assert len(said) == 1
    assert words in said[0]


def test_parameters_reach_the_node_or_that_is_said(tmp_path: Path, capsys: Capture) -> None:
    file = tmp_path / "rig.yaml"
    file.write_text("/rig1/plane_controller: {ros__parameters: {curvature: 8.0}}")
    assert rerun(BAG, "--params", file) == 2
    assert "this node is /plane_controller: write '/plane_controller'" in capsys.readouterr().err
    file.write_text("device_driver: {ros__parameters: {max_depth: 0.1}}")
    assert rerun(BAG, "--params", file) == 0
    warning = f"warning: {file}: no section for /plane_controller: it has device_driver"
    assert capsys.readouterr().err.splitlines()[0] == warning


def test_a_bag_without_parameters_says_what_to_do(
    make_run: Callable[..., Path], capsys: Capture
) -> None:
    assert rerun(make_run()) == 2
    assert "give them with --params" in capsys.readouterr().err


def test_help_teaches(capsys: Capture) -> None:
    with pytest.raises(SystemExit) as ended:
        rerun("--help")
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    assert "exit codes" in printed
    assert "tolerances" in printed
