"""`rerun`: equal outputs of unchanged code, failure for a wrong gain or sign, one-line errors."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rclpy.parameter import Parameter

from made_up_run import STORE, copy_messages, header, message, serialized
from needle_bags.format.bag_writer import BagCopy, standard_topic, string_message
from needle_bags.link import openigtlink
from needle_bags.live import live_view
from needle_bags.reading.bag_messages import raw_as_sent, read_contents, read_messages
from needle_bags.reading.bag_reader import read_run
from needle_bags.rerun.rerun_bag import TABLE, write_rerun
from needle_bags.rerun.stages import Output
from needle_bags.ros import rerun as rerun_node
from needle_core.errors import UserError
from needle_core.files.bag_topic import BagTopic
from needle_tracker.optics.calibration import StereoCalibration, parse_calibration

PICTURES = live_view.PICTURES.values()
EVENT, TEXT = "rcl_interfaces/msg/ParameterEvent", "std_msgs/msg/String"

Capture = pytest.CaptureFixture[str]

Shown = tuple[Path, Path, str]


def rerun(*arguments: object) -> int:
    return rerun_node.main([str(argument) for argument in arguments])


def printed(*arguments: object) -> tuple[int, str]:
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        code = rerun(*arguments)
    return code, out.getvalue()


def changed_fields(result: Path) -> set[str]:
    values: dict[str, Any] = json.loads(result.read_text())
    ending = "_differing"
    return {key.removesuffix(ending) for key, v in values.items() if key.endswith(ending) and v}


def given(folder: Path, text: str, node: str = "plane_controller") -> Path:
    file = folder / "given.yaml"
    file.write_text(f"{node}: {{ros__parameters: {{{text}}}}}")
    return file


@pytest.fixture(scope="module")
def untouched(regression: Path) -> tuple[int, str]:
    """Rerun the whole committed bag."""
    return printed(regression)


@pytest.fixture(scope="module")
def mirrored(first_pictures: Path) -> tuple[int, str]:
    """Rerun the bag up to its first pictures by code with an inverted sign."""

    def mirror(document: Any) -> StereoCalibration:
        calibration = parse_calibration(document)
        matrix = calibration.left.camera_matrix * np.array([[1, 1, 1], [1, -1, 1], [1, 1, 1]])
        left = dataclasses.replace(calibration.left, camera_matrix=matrix)
        return dataclasses.replace(calibration, left=left)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rerun_node, "parse_calibration", mirror)
        return printed(first_pictures)


@pytest.fixture(scope="module")
def paper_bag(tmp_path_factory: pytest.TempPathFactory, eight_steps: Path) -> Path:
    """The first steps, as preset paper would command them."""
    bag = tmp_path_factory.mktemp("rerun") / "paper"
    assert rerun(eight_steps, "--preset", "paper", "--output", bag) == 1
    return bag


def test_unchanged_code_gives_unchanged_outputs(
    untouched: tuple[int, str], regression: Path
) -> None:
    code, output = untouched
    assert code == 0, f"{output}\nmeant? scripts/renew_regression_bag"
    assert "6 image pairs through stereo_tracker, 121 tips through plane_controller" in output
    assert "UNCHANGED" in output
    # The table for reviewers of a diff must match the bag in the same folder.
    rows = (regression / TABLE).read_text().splitlines()[1:]
    assert len(rows) == read_contents(regression).counts["/needle/estimate"]


def test_a_wrong_sign_in_the_projection_is_detected(mirrored: tuple[int, str]) -> None:
    code, output = mirrored
    assert code == 1
    assert "needle/tip: 1 recorded only (at 30.0 mm" in output


@pytest.mark.parametrize(
    ("parameter", "field"),
    [
        ("curvature", "needle_control_input_u"),
        ("target_offset", "needle_reduced_state_r1"),
        ("step_length", "device_joint_trajectory_insertion"),
    ],
)
def test_a_parameter_off_by_a_hundredth_is_detected(
    eight_steps: Path, tmp_path: Path, parameter: str, field: str
) -> None:
    value = 1.01 * read_run(eight_steps).parameter("plane_controller", parameter)
    file, result = given(tmp_path, f"{parameter}: {value}"), tmp_path / "result.json"
    assert rerun(eight_steps, "--params", file, "--json", result) == 1
    assert field in changed_fields(result)


def test_another_preset_gives_a_separate_run(eight_steps: Path, paper_bag: Path) -> None:
    code, output = printed(paper_bag)
    assert code == 0
    assert "(paper)" in output
    # Apart from the outputs, it is the same bag.
    before, after = read_contents(eight_steps), read_contents(paper_bag)
    assert before.counts == after.counts
    for topic in ("/joint_states", "/device/status", "/sim/tip_pose"):
        kept = [
            [(m.log_time, m.data) for m in raw_as_sent(bag, topic.__eq__)]
            for bag in (eight_steps, paper_bag)
        ]
        assert kept[0] == kept[1]
    lines = (paper_bag / TABLE).read_text().splitlines()
    assert len(lines) == 1 + before.counts["/needle/estimate"]
    assert lines[0].split()[:3] == ["insertion_mm", "tip_x_mm", "tip_y_mm"]


def test_tips_without_images_are_kept(eight_steps: Path, tmp_path: Path) -> None:
    run, topic = read_run(eight_steps), "/needle/tip"
    tips = [message for _, _, message in read_messages(eight_steps, topic.__eq__)]
    tips[3].point.x = 0.5
    output = Output("needle/tip", run.tips.received[3], int(run.tips.stamps[3]), tips[3])
    write_rerun(run, tmp_path / "bag", [output], {}, "")
    assert read_contents(tmp_path / "bag").counts == read_contents(eight_steps).counts
    after = read_run(tmp_path / "bag").tips.values
    assert np.flatnonzero((after != run.tips.values).any(axis=1)).tolist() == [3]


@pytest.fixture(scope="module")
def shown(first_pictures: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Rerun the bag up to its first pictures for viewers, with pyigtl; return bag and output."""
    bag = tmp_path_factory.mktemp("rerun") / "shown"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("importlib.util.find_spec", lambda _: True)
        patch.setattr(openigtlink, "packed", lambda *_: b"needle")
        code, output = printed(first_pictures, "--viewers", "--output", bag)
    assert code == 0, output
    return bag, output


def test_viewers_show_the_recorded_needle_without_comparison(
    shown: tuple[Path, str], first_pictures: Path
) -> None:
    bag, output = shown
    before, after = read_contents(first_pictures).counts, read_contents(bag).counts
    new = {topic.removeprefix("/"): n for topic, n in (after - before).items()}
    assert new.keys() == {live_view.TIP, live_view.PATH, live_view.MARKERS, *PICTURES}
    (view,) = [line for line in output.splitlines() if line.startswith("live_view: ")]
    assert "nothing to compare, because its update times are not recorded; sent " in view
    for topic, count in new.items():
        assert f"{count} {topic}" in view
    run = read_run(first_pictures)
    seconds = (run.joints.received[-1] - run.joints.received[0]) * 1e-9
    # Ten messages per second, and each picture once.
    assert new[live_view.PATH] == pytest.approx(10 * seconds, abs=3)
    assert {new[topic] for topic in PICTURES} == {before["/stereo/left/image_raw/compressed"]}
    *_, (_, _, path) = read_messages(bag, f"/{live_view.PATH}".__eq__)
    tip = path.poses[-1].pose.position
    assert (tip.x, tip.y, tip.z) == tuple(run.tips.values[-1])
    (link,) = [line for line in output.splitlines() if line.startswith("openigtlink: ")]
    assert "nothing to compare, because ports are not recorded; sent " in link
    assert int(link.split()[-2]) == pytest.approx(10 * seconds, abs=3)


@pytest.fixture(scope="module")
def shown_again(shown: tuple[Path, str], tmp_path_factory: pytest.TempPathFactory) -> Shown:
    """Return the rerun of a bag that already contains the viewers' topics."""
    folder = tmp_path_factory.mktemp("again")
    bag, file = folder / "bag", folder / "result.json"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("importlib.util.find_spec", lambda _: None)
        code, output = printed(shown[0], "--viewers", "--output", bag, "--json", file)
    assert code == 0
    return bag, file, output


def test_recorded_viewer_topics_are_replaced(shown: tuple[Path, str], shown_again: Shown) -> None:
    bag, file, output = shown_again
    counts = read_contents(shown[0]).counts
    assert json.loads(file.read_text())["live_view_path_sent"] == counts["/live_view/path"]
    assert read_contents(bag).counts == counts
    assert "openigtlink: left out, pyigtl is not installed" in output


def copied(bag: Path, target: Path, custom: dict[str, str], topic: BagTopic, first: bytes) -> None:
    """Copy a bag with other custom data, after a message of a new topic."""
    copy, start = BagCopy(target, "jazzy", custom), read_contents(bag).start
    copy.put(topic, first, start, start)
    copy_messages(bag, copy)
    copy.close()


def test_announced_parameters_are_sufficient(eight_steps: Path, tmp_path: Path) -> None:
    """A bag of ROS 2's own recorder has no custom data, but /parameter_events."""
    node = "/plane_controller"
    announced = event(node, read_run(eight_steps).parameters[node])
    topic = standard_topic("/parameter_events", EVENT)
    copied(eight_steps, tmp_path / "bag", {}, topic, serialized(announced))
    assert rerun(tmp_path / "bag") == 0


def event(node: str, parameters: dict[str, Any]) -> Any:
    """Return the ParameterEvent of a node at its start."""
    kinds = {"byte": np.uint8, "bool": np.bool_, "integer": np.int64, "double": np.float64}

    def value(content: Any) -> Any:
        made = Parameter("", value=content).get_parameter_value()
        fields = {name: getattr(made, name) for name in made.get_fields_and_field_types()}
        for kind, numbers in kinds.items():
            # rclpy has lists; rosbags requires arrays.
            name = f"{kind}_array_value"
            fields[name] = np.array(fields[name], numbers)
        return message("rcl_interfaces/msg/ParameterValue", **fields)

    parameter = STORE.types["rcl_interfaces/msg/Parameter"]
    new = [parameter(name, value(content)) for name, content in parameters.items()]
    return STORE.types[EVENT](header(10**9).stamp, node, new, [], [])


def test_the_calibration_is_that_of_the_tracker_or_of_params(
    eight_steps: Path, first_pictures: Path, tmp_path: Path
) -> None:
    """The tracker publishes it on its own topic, so the recorder needs no setting."""
    text = read_run(eight_steps).calibration
    bag, topic = tmp_path / "bag", standard_topic("/stereo_tracker/calibration", TEXT)
    copied(eight_steps, bag, {"calibration": "left: {}"}, topic, string_message(text))
    run = read_run(bag)
    assert run.calibration == text
    other = tmp_path / "other.yaml"
    changed = yaml.safe_load(text)
    changed["phantom"]["refractive_index"] += 0.01
    other.write_text(yaml.safe_dump(changed))
    file = given(tmp_path, f"calibration_file: {other}", "stereo_tracker")
    used_texts: list[str] = []

    def stop(_: object, __: object, used: str) -> None:
        used_texts.append(used)
        raise UserError("seen")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rerun_node, "_tracker", stop)
        for arguments in ((), ("--params", file)):
            assert rerun(first_pictures, *arguments) == 2
    assert used_texts == [text, other.read_text()]


def test_bad_input_gives_a_one_line_error(
    eight_steps: Path, make_run: Callable[..., Path], tmp_path: Path, capsys: Capture
) -> None:
    table: dict[tuple[object, ...], str] = {
        (eight_steps, "--preset", "bset"): "--preset 'bset' is not one of",
        (eight_steps, "--json", "/nowhere/at/all.json"): "its folder must exist",
        (eight_steps, "--params", "/nowhere.yaml"): "/nowhere.yaml",
        (eight_steps, "--output", eight_steps): "already contains a bag",
        (eight_steps, "--presets", "best"): "see --help",
        (make_run(steps=3),): "give them with --params",
    }
    for arguments, words in table.items():
        assert rerun(*arguments) == 2
        error = capsys.readouterr().err
        assert words in error
        assert error.count("\n") == 1
    for text, words in (
        ("curvatur: 8.0", "has no parameter curvatur"),
        ("curvature: -8.0", "curvature = -8"),
        ("curvature: high", "curvature"),
    ):
        assert rerun(eight_steps, "--params", given(tmp_path, text)) == 2
        # It first warns of parameters in the bag that today's nodes lack.
        lines = capsys.readouterr().err.splitlines()
        (line,) = [line for line in lines if "no longer has" not in line]
        assert words in line
