"""What sim_rig makes of drives: the needle goes only where one can be; a pause is told."""

import math

import pytest
from sensor_msgs.msg import JointState

from needle_sim.ros.drive_follower import is_paused, places_of

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


@pytest.mark.parametrize(
    ("activity", "needs_time", "speed_scale", "paused"),
    [
        ("step", "false", "1", True),
        ("step", "true", "1", False),
        ("none", "false", "1", False),
        # who rests a pedal at 0, or lets go of it, pauses it knowingly
        ("step", "false", "0", False),
    ],
)
def test_a_motion_that_waits_for_a_silent_hold_is_paused(
    activity: str, needs_time: str, speed_scale: str, paused: bool
) -> None:
    status = {"activity": activity, "needs_time": needs_time, "speed_scale": speed_scale}
    assert is_paused(status) is paused


def test_a_device_that_has_said_nothing_is_not_paused() -> None:
    assert not is_paused({})
