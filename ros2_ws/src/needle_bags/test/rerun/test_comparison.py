from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from needle_bags.rerun.comparison import ANGLE, LENGTH, Comparison, Record, compare

EYE = np.eye(6)


def state(stamp: int, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Record:
    values = {"header.frame_id": "target_plane", "vector.x": x, "vector.y": y, "vector.z": z}
    return Record("needle/reduced_state", stamp, values)


def pose(orientation: Any = (0.0, 0.0, 0.0, 1.0), covariance: Any = EYE) -> Record:
    values: dict[str, Any] = {f"pose.pose.position.{name}": 0.0 for name in "xyz"}
    for name, part in zip("xyzw", orientation, strict=True):
        values[f"pose.pose.orientation.{name}"] = part
    parts = np.ravel(covariance).tolist()
    values |= {f"pose.covariance.{k}": part for k, part in enumerate(parts)}
    return Record("needle/estimate", 1, values)


def differing(comparison: Comparison) -> dict[str, int]:
    return {field.field: field.differing for field in comparison.fields if field.differing}


def test_equal_messages_agree_and_a_number_differs_from_nan() -> None:
    records = [state(1, 0.1, math.nan, math.inf), state(2)]
    result = compare(records, list(reversed(records)))
    assert not result.changed
    assert all(field.largest == 0.0 and field.compared == 2 for field in result.fields)
    for odd in (math.nan, math.inf):
        for pair in ((odd, 0.0), (0.0, odd)):
            result = compare([state(1, pair[0])], [state(1, pair[1])])
            assert differing(result) == {"r1": 1}
            assert result.fields[0].largest == math.inf


def test_the_tolerance_is_applied_at_its_bound() -> None:
    for member, field, tolerance in (("x", "r1", LENGTH), ("z", "r3", ANGLE)):
        allowed = tolerance.absolute + tolerance.relative * 0.5
        for factor, changed in ((0.99, False), (1.01, True), (-0.99, False), (-1.01, True)):
            today = state(1, **{member: 0.5 + factor * allowed})
            result = compare([state(1, **{member: 0.5})], [today])
            assert differing(result) == ({field: 1} if changed else {})
            assert result.changed is changed
    # A frame has no tolerance.
    other = Record("needle/reduced_state", 1, {**state(1).values, "header.frame_id": "rig"})
    assert differing(compare([state(1)], [other])) == {"everything else": 1}


def test_messages_that_only_one_side_has_are_named_by_stamp() -> None:
    result = compare([state(1), state(2), state(2)], [state(2), state(3)])
    assert result.changed
    assert (result.topics[0].missing, result.topics[0].extra) == ((1, 2), (3,))
    assert result.fields[0].compared == 1


def test_a_quaternion_and_its_negative_are_one_rotation() -> None:
    q = (0.5, -0.5, 0.5, 0.5)
    assert not compare([pose(q)], [pose(tuple(-part for part in q))]).changed
    assert differing(compare([pose(q)], [pose((-0.5, *q[1:]))])) == {"orientation": 1}


def test_covariances_are_compared_in_sigmas() -> None:
    small = np.diag([1e-8] * 3 + [1.0] * 3)
    other, angles, nothing = small.copy(), small.copy(), np.full((6, 6), math.inf)
    other[0, 1] = other[1, 0] = angles[3, 4] = angles[4, 3] = 2e-11
    result = compare([pose(covariance=small)], [pose(covariance=other)])
    assert differing(result) == {"covariance": 1}
    assert result.fields[2].largest == pytest.approx(2e-3)
    # The same difference between angles, whose sigmas are 1 rad, is negligible.
    for before, now, changed in (
        (small, angles, False),
        (nothing, nothing.copy(), False),
        (nothing, small, True),
    ):
        assert compare([pose(covariance=before)], [pose(covariance=now)]).changed is changed
