"""The needle goes only where a drive can be."""

import math

import pytest
from sensor_msgs.msg import JointState

from needle_sim.ros.drive_follower import places_of

JOINTS = ["insertion_joint", "rotation_joint"]


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("place", [math.nan, math.inf, -math.inf, 1e300, -1e30])
def test_where_no_drive_is_the_needle_does_not_go(joint: int, place: float) -> None:
    position = [0.05, 1.0]
    position[joint] = place
    with pytest.raises(ValueError, match=JOINTS[joint]):
        places_of(JointState(name=JOINTS, position=position))


def test_a_joint_that_is_not_told_is_refused() -> None:
    with pytest.raises(ValueError, match="rotation_joint"):
        places_of(JointState(name=JOINTS[:1], position=[0.05]))


def test_where_a_drive_is_the_needle_goes() -> None:
    places = places_of(JointState(name=JOINTS, position=[0.05, -300.0]))
    assert places == {"insertion_joint": 0.05, "rotation_joint": -300.0}
