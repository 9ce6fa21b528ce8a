from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from needle_analysis.rerun.bag_pass import CONVERTER
from needle_analysis.rerun.comparison import (
    ANGLE,
    LENGTH,
    Comparison,
    Record,
    Tolerance,
    compare,
    members,
)
from needle_core import messages as m


def state(stamp: int, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Record:
    values = {"header.frame_id": "target_plane", "vector.x": x, "vector.y": y, "vector.z": z}
    return Record("needle/reduced_state", stamp, values)


def pose(
    orientation: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0), covariance: np.ndarray | None = None
) -> Record:
    values: dict[str, Any] = {f"pose.pose.position.{name}": 0.0 for name in "xyz"}
    for name, part in zip("xyzw", orientation, strict=True):
        values[f"pose.pose.orientation.{name}"] = part
    values["pose.covariance"] = np.eye(6).ravel() if covariance is None else np.ravel(covariance)
    return Record("needle/estimate", 1, values)


def differing(comparison: Comparison) -> dict[str, int]:
    return {field.field: field.differing for field in comparison.fields if field.differing}


def test_equal_messages_agree_to_the_last_bit() -> None:
    records = [state(1, 0.1, math.nan, math.inf), state(2)]
    result = compare(records, list(reversed(records)))
    assert not result.changed
    assert all(field.largest == 0.0 and field.compared == 2 for field in result.fields)


@pytest.mark.parametrize(
    ("member", "field", "tolerance"), [("x", "r1", LENGTH), ("z", "r3", ANGLE)]
)
def test_the_tolerance_is_where_it_is_said_to_be(
    member: str, field: str, tolerance: Tolerance
) -> None:
    value = 0.5
    allowed = tolerance.absolute + tolerance.relative * value
    for factor, changed in ((0.99, False), (1.01, True), (-0.99, False), (-1.01, True)):
        today = state(1, **{member: value + factor * allowed})
        result = compare([state(1, **{member: value})], [today])
        assert differing(result) == ({field: 1} if changed else {})
        assert result.changed is changed


def test_a_number_beside_none_differs_whatever_the_tolerance() -> None:
    for odd in (math.nan, math.inf):
        for pair in ((odd, 0.0), (0.0, odd)):
            result = compare([state(1, pair[0])], [state(1, pair[1])])
            assert differing(result) == {"r1": 1}
            assert result.fields[0].largest == math.inf


def test_messages_that_only_one_side_has_are_named_by_stamp() -> None:
    result = compare([state(1), state(2), state(2)], [state(2), state(3)])
    assert result.changed
    assert result.topics[0].missing == (1, 2)
    assert result.topics[0].extra == (3,)
    assert result.fields[0].compared == 1


def test_a_quaternion_and_its_negative_are_one_rotation() -> None:
    q = (0.5, -0.5, 0.5, 0.5)
    assert not compare([pose(q)], [pose(tuple(-part for part in q))]).changed
    turned = (-0.5, -0.5, 0.5, 0.5)
    assert differing(compare([pose(q)], [pose(turned)])) == {"orientation": 1}


def test_covariances_are_compared_in_sigmas() -> None:
    small = np.diag([1e-8] * 3 + [1.0] * 3)
    other = small.copy()
    other[0, 1] = other[1, 0] = 2e-11
    result = compare([pose(covariance=small)], [pose(covariance=other)])
    assert differing(result) == {"covariance": 1}
    assert result.fields[2].largest == pytest.approx(2e-3)
    # The same difference between angles, whose sigmas are 1 rad, is nothing.
    other[0, 1] = other[1, 0] = 0.0
    other[3, 4] = other[4, 3] = 2e-11
    assert not compare([pose(covariance=small)], [pose(covariance=other)]).changed
    nothing = np.full((6, 6), math.inf)
    assert not compare([pose(covariance=nothing)], [pose(covariance=nothing.copy())]).changed
    assert compare([pose(covariance=nothing)], [pose(covariance=small)]).changed


def test_a_frame_has_no_tolerance() -> None:
    other = Record("needle/reduced_state", 1, {**state(1).values, "header.frame_id": "rig"})
    assert differing(compare([state(1)], [other])) == {"everything else": 1}


def test_members_of_a_message_are_found_by_path() -> None:
    point = m.TrajectoryPoint((0.012, -0.5), 500e-9)
    command = m.Trajectory(3_000_000_000, ("a", "b"), (point,))
    found = dict(members(CONVERTER.to_ros(command)))
    assert found["points.0.positions.0"] == 0.012
    assert found["points.0.positions.1"] == -0.5
    assert found["points.0.time_from_start"] == pytest.approx(500e-9)
    assert found["joint_names.1"] == "b"
    assert found["header.stamp"] == 3.0
