"""Agreement of the URDF as read by pytransform3d, the calibration and the published frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytransform3d.transformations import transform_from_pq
from pytransform3d.urdf import UrdfTransformManager

from needle_bags.live.live_messages import fixed_transforms, to_transforms
from needle_bags.live.live_needle import LiveNeedle
from needle_bags.live.rig_model import camera_bodies, joint_attributes, rig_urdf
from needle_core import messages as m
from needle_core.errors import UserError
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_tracker.optics.calibration import StereoCalibration, load_calibration

CONFIG = Path(__file__).parents[4] / "src/needle_tracker/config"
LIMITS = SafetyLimits(max_depth=0.15, max_speed=0.004, max_turns=2.0, max_rotation_rate=1.5)
MOVED = {"insertion_joint": 0.07, "rotation_joint": -1.3}


@pytest.fixture(params=["calibration.yaml", "calibration_top_and_side.yaml"])
def calibration(request: pytest.FixtureRequest) -> StereoCalibration:
    return load_calibration(CONFIG / request.param)


def loaded(calibration: StereoCalibration) -> UrdfTransformManager:
    rig = UrdfTransformManager()
    rig.load_urdf(rig_urdf(calibration, LIMITS, 0.0009))
    for joint, position in MOVED.items():
        rig.set_joint(joint, position)
    return rig


def shape(rig: UrdfTransformManager, link: str) -> Any:
    (found,) = (one for one in rig.visuals if one.frame.startswith(f"visual:{link}"))
    return found


def test_frames_and_limits_are_those_of_calibration_and_parameters(
    calibration: StereoCalibration,
) -> None:
    rig = loaded(calibration)
    for side, camera in calibration.cameras.items():
        T_optical_rig = rig.get_transform("rig", f"{side}_camera_optical")
        np.testing.assert_allclose(T_optical_rig, camera.T_optical_rig, atol=1e-10)
    assert rig.get_joint_limits("insertion_joint") == (0.0, 0.15)
    assert rig.get_joint_limits("rotation_joint") == pytest.approx((-4 * np.pi, 4 * np.pi))
    attributes = joint_attributes(rig_urdf(calibration, LIMITS, 0.0009))
    assert attributes["insertion_joint limit velocity"] == "0.004"
    assert attributes["rotation_joint limit velocity"] == "1.5"


def test_the_shaft_reaches_from_the_holder_to_the_insertion(calibration: StereoCalibration) -> None:
    rig = loaded(calibration)
    c, s = np.cos(MOVED["rotation_joint"]), np.sin(MOVED["rotation_joint"])
    T_rig_shaft = [[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, MOVED["insertion_joint"]], [0, 0, 0, 1]]
    np.testing.assert_allclose(rig.get_transform("shaft", "rig"), T_rig_shaft, atol=1e-12)
    shaft = shape(rig, "shaft")
    assert (shaft.radius, shaft.length) == (0.00045, 0.2)
    middle = rig.get_transform(shaft.frame, "shaft")[:3, 3]
    np.testing.assert_allclose(middle, [0.0, 0.0, -0.1], atol=1e-12)


def test_published_transforms_are_those_of_the_urdf(calibration: StereoCalibration) -> None:
    rig, needle = loaded(calibration), LiveNeedle()
    needle.joints = m.JointState(9, tuple(MOVED), tuple(MOVED.values()))
    moving = to_transforms(needle, 1)
    assert moving is not None
    assert {one.stamp_ns for one in moving.transforms} == {9}
    fixed = fixed_transforms(camera_bodies(calibration), 1)
    published = (*fixed.transforms, *moving.transforms)
    for one in published:
        x, y, z, w = one.rotation
        pose = transform_from_pq([*one.translation, w, x, y, z])
        expected = rig.get_transform(one.child_frame_id, one.frame_id)
        np.testing.assert_allclose(pose, expected, atol=1e-10)
    # Each link of the URDF except the root has the same single parent.
    links = {one.child_frame_id: one.frame_id for one in published}
    attributes = joint_attributes(rig_urdf(calibration, LIMITS, 0.0009))
    names = {name.split()[0] for name in attributes}
    tree = {attributes[f"{n} child link"]: attributes[f"{n} parent link"] for n in names}
    assert links == tree
    needle.joints = m.JointState(9, ("insertion_joint", "rotation_joint"), (0.0, np.nan))
    assert to_transforms(needle, 1) is None


@pytest.mark.parametrize("text", ["", "<robot>", "<robot><joint type='fixed'/></robot>"])
def test_other_files_are_rejected_as_urdf(text: str) -> None:
    with pytest.raises(UserError, match="not a URDF: "):
        joint_attributes(text)
