from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_analysis.run.run_summary import reduced_states, summarize
from needle_bags.format.bag_copy import BagCopy
from needle_bags.format.bag_writer import BagWriter
from needle_bags.reading.bag_files import read_contents
from needle_bags.reading.bag_order import raw_as_sent
from needle_bags.reading.bag_reader import HealthEvent, Series, _Collector, read_run
from needle_core.errors import UserError

MakeRun = Callable[..., Path]


def test_summary_of_a_known_run(make_run: MakeRun) -> None:
    summary = summarize(read_run(make_run()), wall_s=12.5)
    assert summary["r1_initial_mm"] == pytest.approx(-3.0)
    assert summary["r1_final_mm"] == pytest.approx(-0.25)
    assert summary["tip_error_p95_mm"] == pytest.approx(0.5)
    assert summary["depth_error_p95_mm"] == pytest.approx(0.3)
    assert summary["steps_per_s"] == pytest.approx(20.0)
    assert summary["insertion_final_mm"] == pytest.approx(120.0)
    assert summary["rotation_total_deg"] == pytest.approx(math.degrees(12.0))
    assert summary["watchdog_trips"] == 3
    wanted = {"level": "tip", "controller": "paper", "seed": 7, "steps": 120, "wall_s": 12.5}
    assert {key: summary[key] for key in wanted} == wanted
    assert summary["converged"] is True


def test_ticks_without_an_answer_are_watchdog_trips(make_run: MakeRun) -> None:
    # At level drive sim_rig has no status of its own to count them in.
    tick = HealthEvent(0, "sim_rig: watchdogs", 1, "the drives left a tick unanswered (1)")
    well = HealthEvent(1, "stereo_tracker: track", 1, "LOST")
    run = dataclasses.replace(read_run(make_run()), health=[tick, well])
    assert summarize(run)["watchdog_trips"] == 3 + 1


def test_rms_is_over_the_last_20_mm(make_run: MakeRun) -> None:
    depth = np.arange(100, 121) / 120
    r1 = -0.25 + (-2.75) * (1 + np.cos(np.pi * depth)) / 2
    summary = summarize(read_run(make_run()))
    assert summary["r1_rms_last_20_mm"] == pytest.approx(np.sqrt(np.mean(r1**2)))


def test_a_run_that_stopped_on_its_way_has_not_converged(make_run: MakeRun) -> None:
    summary = summarize(read_run(make_run(steps=110, done=False)))
    assert abs(float(str(summary["r1_final_mm"]))) < 1.0
    assert summary["converged"] is False
    assert summary["reached_depth"] is False
    assert summary["reason"] == "no tip for 2 s"


def test_without_truth_its_figures_are_null(make_run: MakeRun) -> None:
    summary = summarize(read_run(make_run(truth=False)))
    for key in ("r1_final_mm", "r1_rms_last_20_mm", "tip_error_p95_mm", "depth_error_p95_mm"):
        assert summary[key] is None
    assert summary["converged"] is False
    assert summary["steps"] == 120


def test_a_namespace_is_found(make_run: MakeRun) -> None:
    run = read_run(make_run(namespace="/bench/left/"))
    assert run.namespace == "/bench/left/"
    assert len(run.tips) == 121


@pytest.fixture
def two_rigs(make_run: MakeRun, tmp_path: Path) -> Path:
    """A bag of a rig without a namespace, and of a shorter run of one in /bench."""
    copy = BagCopy(tmp_path / "two", "jazzy", {})
    for bag in (make_run("one"), make_run("other", namespace="/bench/", steps=60)):
        contents = read_contents(bag)
        for m in raw_as_sent(bag, lambda _: True, lambda _: False):
            copy.put(contents.topics[m.topic], m.data, m.log_time, m.time)
    copy.close()
    return tmp_path / "two"


def test_of_two_rigs_one_has_to_be_chosen(two_rigs: Path) -> None:
    with pytest.raises(UserError, match=r"two holds 2 rigs, in /, /bench: choose one with --names"):
        read_run(two_rigs)
    with pytest.raises(UserError, match=r"two has no rig in /desk; it has those in /, /bench"):
        read_run(two_rigs, "/desk")
    for name in ("bench", "/bench", "/bench/"):
        run = read_run(two_rigs, name)
        assert (run.namespace, len(run.tips)) == ("/bench/", 61)
    assert len(read_run(two_rigs, "/").tips) == 121


def test_a_rigs_parameters_are_its_own_nodes(make_run: MakeRun) -> None:
    run = read_run(make_run(namespace="/bench/"))
    nodes = {"/sim_rig": {"seed": 1}, "/bench/sim_rig": {"seed": 2}, "/desk/tracker": {"a": 3}}
    run = dataclasses.replace(run, parameters=nodes)
    assert run.parameter("sim_rig", "seed") == 2
    assert run.parameter("tracker", "a") == 3
    nodes["/desk/sim_rig"] = nodes.pop("/bench/sim_rig")
    assert run.parameter("sim_rig", "seed") is None


def test_health_is_the_chosen_rigs() -> None:
    def status(name: str) -> Any:
        return SimpleNamespace(name=name, level=1, message="not well")

    names = ("sim_rig: a", "bench/sim_rig: b", "camera/left: c")
    for namespace, kept in (
        ("/", ["sim_rig: a", "camera/left: c"]),
        ("/bench/", ["sim_rig: a", "sim_rig: b", "camera/left: c"]),
    ):
        collected = _Collector(namespace, ["/", "/bench/"])
        collected.take_diagnostics(0, SimpleNamespace(status=[status(name) for name in names]))
        assert [event.part for event in collected.health] == kept


def test_holds_of_two_sessions_are_both_kept_at_the_times_of_their_arrival() -> None:
    collected = _Collector("/", ["/"])
    for time, session in ((10, "a"), (20, "b")):
        # The first message of each.
        header = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=1), frame_id=f"me/{session}")
        joy = SimpleNamespace(header=header, axes=[0.5], buttons=[1])
        collected.takers()["device/hold"](time, joy)
    holds = collected.series("holds", 2)
    assert holds.stamps.tolist() == holds.received.tolist() == [10, 20]


def test_reduced_states_undo_the_rotation() -> None:
    rng = np.random.default_rng(3)
    angles = rng.uniform(-1.2, 1.2, (50, 3))
    rotation = Rotation.from_euler("XYZ", angles)
    poses = np.hstack([rng.normal(size=(50, 3)), rotation.as_quat()])
    states = reduced_states(Series(np.arange(50), poses, np.arange(50)), 0.5)
    np.testing.assert_allclose(states[:, 0], poses[:, 0] - 0.5)
    np.testing.assert_allclose(states[:, 1:], angles[:, 1:], atol=1e-12)


def test_insertion_is_interpolated(make_run: MakeRun) -> None:
    run = read_run(make_run())
    middle = (run.joints.stamps[:-1] + run.joints.stamps[1:]) // 2
    wanted = (np.arange(120) + 0.5) * 1e-3
    np.testing.assert_allclose(run.insertion_at(middle), wanted, atol=1e-12)


def missing(_: Path) -> None:
    return


def not_a_bag(path: Path) -> None:
    path.mkdir()


def without_metadata(path: Path) -> None:
    BagWriter(path).close()
    (path / "metadata.yaml").unlink()


def broken_metadata(path: Path) -> None:
    BagWriter(path).close()
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: [1, {")


def other_yaml(path: Path) -> None:
    BagWriter(path).close()
    (path / "metadata.yaml").write_text("[]")


def truncated(path: Path) -> None:
    BagWriter(path).close()
    data = path / f"{path.name}_0.mcap"
    data.write_bytes(data.read_bytes()[:-20])


def foreign(path: Path) -> None:
    BagWriter(path).close()


BAD_BAGS: list[tuple[Callable[[Path], None], str]] = [
    (missing, "no such bag directory"),
    (not_a_bag, "is not a bag"),
    (without_metadata, "was not completed"),
    (broken_metadata, "is broken"),
    (other_yaml, "is broken"),
    (truncated, "is broken"),
    (foreign, "holds no needle run"),
]


@pytest.mark.parametrize(("make", "words"), BAD_BAGS)
def test_a_bad_bag_is_one_line(tmp_path: Path, make: Callable[[Path], None], words: str) -> None:
    make(tmp_path / "bag")
    with pytest.raises(UserError, match=words) as caught:
        read_run(tmp_path / "bag")
    assert "\n" not in str(caught.value)


def test_a_damaged_run_is_one_line(make_run: MakeRun) -> None:
    path = make_run()
    data = path / "run_0.mcap"
    content = bytearray(data.read_bytes())
    middle = len(content) // 3
    content[middle : middle + 400] = bytes(400)
    data.write_bytes(content)
    with pytest.raises(UserError) as caught:
        read_run(path)
    assert "\n" not in str(caught.value)
