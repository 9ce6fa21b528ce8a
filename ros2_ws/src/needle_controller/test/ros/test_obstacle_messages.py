from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from visualization_msgs.msg import Marker, MarkerArray

from needle_common.errors import UserError
from needle_controller.ros.obstacle_messages import to_obstacles


def marker(kind: int, scale: tuple[float, float, float], **pose: float) -> Marker:
    made = Marker(type=kind, action=Marker.ADD, ns="bone", id=4)
    made.header.frame_id = "rig"
    made.scale.x, made.scale.y, made.scale.z = scale
    made.pose.position.x, made.pose.position.y, made.pose.position.z = 0.01, -0.02, 0.05
    made.pose.orientation.w = 1.0
    for name, value in pose.items():
        setattr(made.pose.orientation, name, value)
    return made


SPHERE = (0.006, 0.006, 0.006)


def test_spheres_and_cylinders_become_capsules() -> None:
    half = math.sqrt(0.5)
    # A quarter turn about x takes z to -y.
    lying = marker(Marker.CYLINDER, (0.004, 0.004, 0.03), x=half, w=half)
    found = to_obstacles(
        MarkerArray(markers=[Marker(action=Marker.DELETEALL), marker(Marker.SPHERE, SPHERE), lying])
    )
    np.testing.assert_allclose(
        found.table,
        [
            [0.01, -0.02, 0.05, 0.01, -0.02, 0.05, 0.003],
            [0.01, -0.005, 0.05, 0.01, -0.035, 0.05, 0.002],
        ],
        atol=1e-12,
    )
    assert len(to_obstacles(MarkerArray())) == 0


def other_frame(made: Marker) -> None:
    made.header.frame_id = "map"


def no_quaternion(made: Marker) -> None:
    made.type = Marker.CYLINDER
    made.pose.orientation.w = 0.0


def set_type(made: Marker) -> None:
    made.type = Marker.CUBE


def oblong(made: Marker) -> None:
    made.scale.y = 0.01


def not_finite(made: Marker) -> None:
    made.pose.position.z = math.nan


def in_mm(made: Marker) -> None:
    made.pose.position.z = 50.0


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (other_frame, r"obstacle 1 \('bone' 4\) is given in frame 'map', wants 'rig'"),
        (set_type, "of type 1, wants SPHERE"),
        (oblong, "is not round"),
        (not_finite, "is not finite"),
        (no_quaternion, "quaternion has length 0"),
        (in_mm, "z of obstacle 1 = 50 m"),
    ],
)
def test_what_is_no_obstacle_is_named(spoil: Any, words: str) -> None:
    made = marker(Marker.SPHERE, SPHERE)
    spoil(made)
    with pytest.raises(UserError, match=words):
        to_obstacles(MarkerArray(markers=[made]))
