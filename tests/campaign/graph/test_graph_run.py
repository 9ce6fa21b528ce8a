"""The whole graph, short runs."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from campaign.checking import SimulateRun, Workbench, payloads, unreadable
from needle_analysis.ros import rerun

SHORT = ("--depth-mm", "10")
SIMULATE = (sys.executable, "-m", "needle_bringup.simulation.simulate")
TOPICS = ("/needle/tip", "/device/joint_trajectory", "/device/result", "/sim/tip_pose")

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


@pytest.mark.parametrize(
    "level", ["tip", "tip --graph", "camera", "camera --graph", "drive", "drive --graph"]
)
def test_it_steers_records_and_reports(run: Run, level: str) -> None:
    level, *mode = level.split()
    finished = run("_".join([level, *mode]), "--level", level, *mode, *SHORT)
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
    recorded = payloads(bag, TOPICS)
    counts = {topic: len(data) for topic, data in recorded.items()}
    results = recorded["/device/result"]
    assert len(results) == counts["/device/joint_trajectory"]
    assert sum(b"succeeded" in result for result in results) == 10
    # In real time a hold may come later than its age limit: that step is aborted and asked anew.
    late = [result for result in results if b"aborted: no hold message for" in result]
    assert len(results) == 10 + (len(late) if mode else 0)
    # One before the first step, one after each; one for every second that nobody waits for a tip.
    assert 11 <= counts["/needle/tip"] <= counts["/sim/tip_pose"]
    assert mode or counts["/sim/tip_pose"] <= 12
    # What was recorded is what the code does, taken through it again. In real time a node may hear
    # less than the recorder until it knows everybody.
    assert mode or rerun.main([str(bag)]) == 0


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
    finished = run("left", "--level", "tip", "--graph", *SHORT)
    assert finished.code == 1, finished.output
    for line, (name, value) in zip(finished.output.splitlines(), left.items(), strict=False):
        assert line.startswith(f"{name}={value} ignored: ")


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
