"""The whole graph, short runs."""

import json
import random
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from needle_analysis.ros import rerun
from needle_verification.checking import SimulateRun, Workbench, payloads, unreadable

SHORT = ("--depth-mm", "10")
SIMULATE = (sys.executable, "-m", "needle_bringup.simulation.simulate")
TOPICS = ("/needle/tip", "/device/joint_trajectory", "/sim/tip_pose")

Run = Callable[..., SimulateRun]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Return a function that runs `simulate` to its end; a name that has run gives its run."""
    bench = Workbench(SIMULATE, tmp_path_factory.mktemp("runs"))

    def finish(name: str, *arguments: str) -> SimulateRun:
        figures = bench.folder / f"{name}.json"
        finished = bench.run(name, *arguments, "--json", str(figures))
        assert finished.left_over == []
        assert finished.left_in_memory == []
        return finished

    return finish


@pytest.mark.parametrize("level", ["tip", "camera", "drive"])
def test_it_steers_records_and_reports(run: Run, level: str) -> None:
    finished = run(level, "--level", level, *SHORT)
    bag = finished.bag
    # 10 mm are too short to come from 3 mm beside the plane to within 1 mm of it
    assert finished.code == 1, finished.output
    assert unreadable(bag) == ""
    summary = json.loads(bag.with_suffix(".json").read_text())
    assert summary == json.loads((bag / "summary.json").read_text())
    assert summary["level"] == level
    assert summary["controller"] == "best"
    assert summary["steps"] == 10
    assert summary["converged"] is False
    assert summary["insertion_final_mm"] == pytest.approx(10.0, abs=0.01)
    assert -4.0 < summary["r1_final_mm"] < -2.0
    assert (bag / "report.html").stat().st_size > 1000
    assert list(bag.glob("*.png"))
    counts = {topic: len(data) for topic, data in payloads(bag, TOPICS).items()}
    assert counts == dict.fromkeys(TOPICS, 10) | {"/needle/tip": 11, "/sim/tip_pose": 11}
    # What was recorded is what the code does, taken through it again.
    assert rerun.main([str(bag)]) == 0


def test_variables_of_another_set_up_are_named_first_and_keep_no_node_away(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = {
        "ROS_DOMAIN_ID": "300",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF",
        "ROS_DISCOVERY_SERVER": "127.0.0.1:11811",
    }
    for name, value in left.items():
        monkeypatch.setenv(name, value)
    finished = run("left", "--level", "tip", *SHORT)
    assert finished.code == 1, finished.output
    for line, (name, value) in zip(finished.output.splitlines(), left.items(), strict=False):
        assert line.startswith(f"{name}={value} ignored: ")


def test_one_seed_is_one_run_and_another_another(run: Run) -> None:
    runs = {
        # The run that is looked at above; --seed 1 is the default.
        "one": run("tip", "--level", "tip", *SHORT),
        "again": run("again", "--level", "tip", *SHORT, "--seed", "1"),
        "other": run("other", "--level", "tip", *SHORT, "--seed", "6"),
    }
    for finished in runs.values():
        assert finished.code == 1, finished.output
    one, again, other = (payloads(finished.bag, TOPICS) for finished in runs.values())
    assert [len(one[topic]) for topic in TOPICS] == [11, 10, 11]
    for topic in TOPICS:
        assert one[topic] == again[topic]
    assert one["/needle/tip"] != other["/needle/tip"]
    assert one["/device/joint_trajectory"] != other["/device/joint_trajectory"]


def test_a_continuous_run_goes_on_and_repeats(run: Run) -> None:
    arguments = ("--level", "tip", "--insertion", "continuous", "--depth-mm", "6")
    one, again = (run(name, *arguments) for name in ("goes_on", "goes_on_again"))
    first, second = (payloads(finished.bag, TOPICS) for finished in (one, again))
    assert first == second
    # 6 mm at 2 mm/s, exposed 25 times a second (every other tick), and a little more at its ends.
    assert 75 <= len(first["/needle/tip"]) <= 85
    summary = json.loads((one.bag / "summary.json").read_text())
    assert summary["steps"] == 6
    assert summary["steps_aborted"] == 0
    assert summary["insertion_final_mm"] == pytest.approx(6.0, abs=0.01)
    assert summary["state"] == "DONE"
    assert rerun.main([str(one.bag)]) == 0


def test_a_continuous_run_whose_nodes_stand_still_is_the_same(run: Run, tmp_path: Path) -> None:
    arguments = ("--level", "tip", "--insertion", "continuous", "--depth-mm", "6")
    usual = payloads(run("goes_on", *arguments).bag, TOPICS)
    bench = Workbench(SIMULATE, tmp_path)
    nodes = ("simulated_operator", "plane_controller", "sim_rig")
    patience = tmp_path / "patience.yaml"
    patience.write_text("sim_rig: {ros__parameters: {reexpose_after: 60.0}}")
    patient = (*arguments, "--params", str(patience))
    paused = bench.run_with_pauses("paused", nodes, random.Random(4), *patient)
    assert paused.code == 1, paused.output
    assert payloads(paused.bag, TOPICS) == usual


@pytest.mark.parametrize(
    "text",
    [
        "plane_controller: {ros__parameters: {curvatur: 9.0}}",
        "sim_rig: {ros__parameters: {tip_nois: 0.0}}",
        "plane_controler: {ros__parameters: {curvature: 9.0}}",
    ],
)
def test_a_bad_parameter_is_named_and_leaves_nothing(run: Run, tmp_path: Path, text: str) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text(text)
    finished = run(text.partition(":")[0], "--level", "tip", "--params", str(file))
    assert finished.code == 2
    name = text.partition(": {ros__parameters: {")[2].partition(":")[0]
    assert (name if "controler" not in text else "plane_controler") in finished.last_line
    assert "Traceback" not in finished.output
    assert not finished.bag.exists()
