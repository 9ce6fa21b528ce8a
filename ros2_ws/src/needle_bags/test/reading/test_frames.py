"""Bags as frames: beside what the typed reader reads of the same bag."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from needle_bags.reading import frames
from needle_bags.reading.bag_reader import Series, read_run
from needle_bags.reading.frames import read_frames
from needle_core.errors import UserError

BAG = Path(__file__).parents[5] / "bags" / "regression"
TYPES = get_typestore(Stores.ROS2_JAZZY).types
POSE = [f"position.{axis}" for axis in "xyz"] + [f"orientation.{axis}" for axis in "xyzw"]


def message(kind: str, **fields: Any) -> Any:
    return TYPES[kind](**fields)


def header(sec: int = 3, nanosec: int = 500_000_000) -> Any:
    stamp = message("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return message("std_msgs/msg/Header", stamp=stamp, frame_id="rig")


def test_frames_have_what_the_typed_reader_has() -> None:
    pytest.importorskip("pandas", reason="the notebooks' lock is not installed: docs/notebooks.md")
    bag, run = read_frames(BAG), read_run(BAG)
    joints = [f"position.{joint}_joint" for joint in ("insertion", "rotation")]
    commands = [f"points.0.positions.{joint}_joint" for joint in ("insertion", "rotation")]
    covariance = [f"pose.covariance.{k}" for k in range(36)]
    wanted: dict[str, tuple[Series, list[str]]] = {
        "/needle/tip": (run.tips, [f"point.{axis}" for axis in "xyz"]),
        "/sim/tip_pose": (run.truth, [f"pose.{name}" for name in POSE]),
        "/needle/estimate": (run.estimate, [f"pose.pose.{name}" for name in POSE]),
        "/needle/reduced_state": (run.reduced_state, [f"vector.{axis}" for axis in "xyz"]),
        "/joint_states": (run.joints, joints),
        "/device/joint_trajectory": (run.commands, commands),
    }
    for topic, (series, columns) in wanted.items():
        # The typed reader keeps the first of equal stamps.
        frame = bag[topic][~bag[topic].index.duplicated()].sort_index()
        np.testing.assert_allclose(frame.index, series.stamps * 1e-9, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(frame[columns].to_numpy(float), series.values)
        np.testing.assert_allclose(frame["received"], series.received * 1e-9, rtol=1e-12)
    estimate = bag["/needle/estimate"]
    np.testing.assert_array_equal(estimate[covariance], run.estimate_covariances.values)
    status = bag["/needle/controller_status"]
    last = run.controller_status[-1].values
    assert status["values.state"].iloc[-1] == last["state"]
    assert status["values.insertion_m"].iloc[-1] == float(last["insertion_m"])
    assert status["values.reachable_depth_m"].dtype == float
    np.testing.assert_array_equal(status.index, status["received"])
    assert [result.outcome for result in run.results] == list(bag["/device/result"]["frame_id"])
    # Of a picture there is no table, and of a type's constants no column.
    assert set(bag) == {topic for topic in run.topics if "image" not in topic}
    assert "OK" not in status


def test_some_topics_alone() -> None:
    pytest.importorskip("pandas", reason="the notebooks' lock is not installed: docs/notebooks.md")
    assert list(read_frames(BAG, ["/needle/tip"])) == ["/needle/tip"]
    with pytest.raises(UserError, match=r"no topic /needle/top \(it has /device/hold, "):
        read_frames(BAG, ["/needle/top"])


def test_health_has_a_row_for_each_status() -> None:
    pair = message("diagnostic_msgs/msg/KeyValue", key="rate_hz", value="30")
    parts = [
        message(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level,
            name=f"part {level}",
            message="well",
            hardware_id="",
            values=[pair],
        )
        for level in (0, 1)
    ]
    health = message("diagnostic_msgs/msg/DiagnosticArray", header=header(), status=parts)
    first, second = frames._rows(health)
    assert first["stamp"] == second["stamp"] == 3.5
    assert (second["level"], second["name"], second["values.rate_hz"]) == (1, "part 1", "30")


def test_points_have_numbers_and_their_joints_names() -> None:
    after = message("builtin_interfaces/msg/Duration", sec=1, nanosec=250_000_000)
    points = [
        message(
            "trajectory_msgs/msg/JointTrajectoryPoint",
            positions=np.array([k, 10.0 * k]),
            velocities=np.array([]),
            accelerations=np.array([]),
            effort=np.array([]),
            time_from_start=after,
        )
        for k in (1.0, 2.0)
    ]
    path = message(
        "trajectory_msgs/msg/JointTrajectory",
        header=header(),
        joint_names=["insertion_joint", "rotation_joint"],
        points=points,
    )
    (row,) = frames._rows(path)
    assert row == {
        "stamp": 3.5,
        "header.frame_id": "rig",
        "points.0.positions.insertion_joint": 1.0,
        "points.0.positions.rotation_joint": 10.0,
        "points.0.time_from_start": 1.25,
        "points.1.positions.insertion_joint": 2.0,
        "points.1.positions.rotation_joint": 20.0,
        "points.1.time_from_start": 1.25,
    }


def test_without_pandas_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(UserError, match=r"pandas is not installed; docs/notebooks\.md"):
        read_frames(BAG)
