"""Bags as data frames, compared with the typed reader."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from made_up_run import header, message
from needle_bags.reading import frames
from needle_bags.reading.bag_reader import Series, read_run
from needle_bags.reading.frames import read_frames
from needle_core.errors import UserError

BAG = Path(__file__).parents[5] / "bags" / "regression"
POSE = [f"position.{axis}" for axis in "xyz"] + [f"orientation.{axis}" for axis in "xyzw"]


@pytest.fixture(scope="module")
def rows() -> dict[str, list[dict[str, Any]]]:
    """Rows of a bag as passed to pandas, which is an extra."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "pandas", SimpleNamespace())
        patch.setattr(frames, "_frame", lambda _, found: found)
        return read_frames(BAG)


def test_rows_agree_with_the_typed_reader(rows: dict[str, list[dict[str, Any]]]) -> None:
    run = read_run(BAG)
    joints = [f"position.{joint}_joint" for joint in ("insertion", "rotation")]
    commands = [f"points.0.positions.{joint}_joint" for joint in ("insertion", "rotation")]

    def table(topic: str, columns: Sequence[str]) -> np.ndarray:
        return np.array([[row[name] for name in columns] for row in rows[topic]], float)

    columns_of: dict[str, tuple[Series, list[str]]] = {
        "/needle/tip": (run.tips, [f"point.{axis}" for axis in "xyz"]),
        "/sim/tip_pose": (run.truth, [f"pose.{name}" for name in POSE]),
        "/needle/estimate": (run.estimate, [f"pose.pose.{name}" for name in POSE]),
        "/joint_states": (run.joints, joints),
        "/device/joint_trajectory": (run.commands, commands),
    }
    for topic, (series, columns) in columns_of.items():
        found = table(topic, ["stamp", "received", *columns])
        # The typed reader keeps only the first of several equal stamps.
        _, first = np.unique(found[:, 0], return_index=True)
        np.testing.assert_allclose(found[first, 0], series.stamps * 1e-9, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found[first, 1], series.received * 1e-9, rtol=1e-12)
        np.testing.assert_array_equal(found[first, 2:], series.values)
    covariance = [f"pose.covariance.{k}" for k in range(36)]
    np.testing.assert_array_equal(
        table("/needle/estimate", covariance), run.estimate_covariances.values
    )
    last, status = run.controller_status[-1].values, rows["/needle/controller_status"][-1]
    assert {f"values.{key}": value for key, value in last.items()}.items() <= status.items()
    # A message without header has its time of arrival.
    assert status["stamp"] == status["received"]
    assert [result.outcome for result in run.results] == [
        row["frame_id"] for row in rows["/device/result"]
    ]
    command = rows["/device/joint_trajectory"][0]
    assert command["points.0.time_from_start"] == pytest.approx(0.5)
    # Images have no table, and constants of a type have no column.
    assert set(rows) == {topic for topic in run.topics if "image" not in topic}
    assert "OK" not in status


def test_missing_dependencies_and_topics_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(UserError, match=r"pandas is not installed: see docs/viewers\.md"):
        read_frames(BAG)
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace())
    with pytest.raises(UserError, match=r"no topic /needle/top \(it has /device/hold, "):
        read_frames(BAG, ["/needle/top"])


def test_health_has_a_row_for_each_status() -> None:
    pair = message("diagnostic_msgs/msg/KeyValue", key="rate_hz", value="30")
    fields = {"message": "well", "hardware_id": "", "values": [pair]}
    kind = "diagnostic_msgs/msg/DiagnosticStatus"
    parts = [message(kind, level=k, name=f"part {k}", **fields) for k in (0, 1)]
    health = message(
        "diagnostic_msgs/msg/DiagnosticArray", header=header(3_500_000_000), status=parts
    )
    first, second = frames._rows(health)
    assert first["stamp"] == second["stamp"] == 3.5
    assert (second["level"], second["name"], second["values.rate_hz"]) == (1, "part 1", "30")
