from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_controller.model.target_plane import check_within_reach, offset_plane, plane_from_pose
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.tip_gate import (
    LARGEST_SCALE,
    AcceptedTip,
    TipMeasurement,
    refuse_message,
    refuse_position,
)
from needle_core.errors import UserError

UNIT = [0.0, 0.0, 0.0, 1.0]
DEPTH = 0.12


def test_the_papers_start_is_3_mm_below_a_plane_at_plus_3_mm() -> None:
    plane = offset_plane(0.003)
    np.testing.assert_allclose(plane.from_rig([0.0, 0.0, 0.0]), [-0.003, 0.0, 0.0])
    assert plane.offset == 0.003


def test_a_general_pose_is_a_rigid_transform() -> None:
    rotation = Rotation.from_euler("xyz", [0.3, -0.4, 0.5])
    origin = np.array([0.001, -0.02, 0.03])
    plane = plane_from_pose("rig", origin, rotation.as_quat())
    np.testing.assert_allclose(plane.T_rig_plane[:3, :3], rotation.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(plane.T_plane_rig @ plane.T_rig_plane, np.eye(4), atol=1e-12)
    points = np.arange(12.0).reshape(2, 2, 3)
    np.testing.assert_allclose(
        plane.from_rig(points).reshape(-1, 3),
        rotation.inv().apply((points - origin).reshape(-1, 3)),
    )
    # The distance of the entry from the plane does not depend on where in the plane its origin is.
    moved = plane_from_pose("rig", origin + rotation.apply([0.0, 0.05, -0.02]), rotation.as_quat())
    assert moved.offset == pytest.approx(plane.offset)


@pytest.mark.parametrize(
    ("frame", "position", "quaternion", "said"),
    [
        ("left_camera_optical", [0, 0, 0], UNIT, "left_camera_optical"),
        ("", [0, 0, 0], UNIT, "wants 'rig'"),
        ("rig", [np.nan, 0, 0], UNIT, "not finite"),
        ("rig", [0, 0, 0], [0, 0, np.inf, 1], "not finite"),
        ("rig", [0, 0, 0], [0, 0, 0, 0], "length 0"),
        ("rig", [0, 0, 0], [0, 0, 0, 2], "length 2"),
        ("rig", [0, 0, 0], [0, np.sqrt(0.5), 0, np.sqrt(0.5)], "90 deg"),
    ],
)
def test_planes_nothing_can_reach_are_refused(
    frame: str, position: list[float], quaternion: list[float], said: str
) -> None:
    with pytest.raises(UserError, match=said):
        plane_from_pose(frame, position, quaternion)


def tip(x: float, y: float, z: float, *, stamp_ns: int = 100, frame: str = "rig") -> TipMeasurement:
    return TipMeasurement(stamp_ns, frame, np.array([x, y, z]))


LAST = AcceptedTip(tip(0.0, 0.0, 0.020, stamp_ns=50), JointSample(50, 0.020, 0.0))
NOW = JointSample(100, 0.021, 0.0)


def test_a_good_tip_passes() -> None:
    assert refuse_message(tip(0.0, 0.0, 0.021), LAST) is None
    assert refuse_message(tip(0.0, 0.0, 0.0), None) is None
    assert refuse_position(tip(0.001, -0.001, 0.022), NOW, LAST, 0.004) is None


@pytest.mark.parametrize(
    ("measured", "said"),
    [
        (tip(np.nan, 0.0, 0.02), "not finite"),
        (tip(0.0, np.inf, 0.02), "not finite"),
        (tip(0.0, 0.0, 0.02, frame="left_camera_optical"), "left_camera_optical"),
        (tip(0.0, 0.0, 0.02, stamp_ns=50), "not newer"),
        (tip(0.0, 0.0, 0.02, stamp_ns=10), "not newer"),
    ],
)
def test_bad_messages_are_named(measured: TipMeasurement, said: str) -> None:
    assert said in str(refuse_message(measured, LAST))


def test_places_no_needle_can_reach_are_named() -> None:
    assert "from the entry point" in str(refuse_position(tip(0.0, 0.0, 21.0), NOW, LAST, 0.004))
    assert "jumped" in str(refuse_position(tip(0.008, 0.0, 0.019), NOW, LAST, 0.004))
    farthest = LARGEST_SCALE * NOW.insertion + 0.004
    assert refuse_position(tip(0.0, 0.0, farthest - 1e-4), NOW, None, 0.004) is None
    assert refuse_position(tip(0.0, 0.0, farthest + 1e-4), NOW, None, 0.004) is not None


@pytest.mark.parametrize("offset", [0.05, -0.05, 3.0])
def test_a_plane_farther_than_the_needle_can_go_is_refused_with_what_it_reaches(
    offset: float,
) -> None:
    with pytest.raises(UserError, match=r"cannot be reached.*reaches planes from .* to "):
        check_within_reach(offset_plane(offset), 1 / 0.122, DEPTH)


def test_reach_is_judged_at_the_runs_depth_but_not_for_a_part_of_an_insertion() -> None:
    check_within_reach(offset_plane(0.02), 1 / 0.122, DEPTH)
    check_within_reach(offset_plane(0.02), 1 / 0.122, 0.01)
    with pytest.raises(UserError, match="cannot be reached"):
        check_within_reach(offset_plane(0.05), 1 / 0.122, 0.15)
    check_within_reach(offset_plane(0.05), 1 / 0.122, 0.19)
