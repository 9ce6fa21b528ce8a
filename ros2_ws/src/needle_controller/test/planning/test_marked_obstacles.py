import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from needle_controller.planning.marked_obstacles import CYLINDER, SPHERE, obstacles_from_markers
from needle_core.errors import UserError
from needle_core.messages import Marker, Markers

UPRIGHT = (0.0, 0.0, 0.0, 1.0)
CUBE, DELETEALL = 1, 3
BALL = Marker("rig", "bone", 4, SPHERE, 0, (0.01, -0.02, 0.05), UPRIGHT, (0.006, 0.006, 0.006))


def test_spheres_and_cylinders_become_capsules() -> None:
    half = math.sqrt(0.5)
    # A quarter turn about x takes z to -y.
    lying = dataclasses.replace(
        BALL, kind=CYLINDER, orientation=(half, 0.0, 0.0, half), scale=(0.004, 0.004, 0.03)
    )
    deleting = dataclasses.replace(BALL, action=DELETEALL, frame_id="")
    found = obstacles_from_markers(Markers((deleting, BALL, lying)))
    np.testing.assert_allclose(
        found.table,
        [
            [0.01, -0.02, 0.05, 0.01, -0.02, 0.05, 0.003],
            [0.01, -0.005, 0.05, 0.01, -0.035, 0.05, 0.002],
        ],
        atol=1e-12,
    )
    assert len(obstacles_from_markers(Markers(()))) == 0


@pytest.mark.parametrize(
    ("spoilt", "words"),
    [
        ({"frame_id": "map"}, r"obstacle 1 \('bone' 4\) is given in frame 'map', wants 'rig'"),
        ({"kind": CUBE}, "of type 1, wants SPHERE"),
        ({"scale": (0.006, 0.01, 0.006)}, "is not round"),
        ({"position": (0.01, -0.02, math.nan)}, "is not finite"),
        ({"kind": CYLINDER, "orientation": (0.0, 0.0, 0.0, 0.0)}, "quaternion has length 0"),
        ({"position": (0.01, -0.02, 50.0)}, "z of obstacle 1 = 50 m"),
    ],
)
def test_what_is_no_obstacle_is_named(spoilt: dict[str, Any], words: str) -> None:
    with pytest.raises(UserError, match=words):
        obstacles_from_markers(Markers((dataclasses.replace(BALL, **spoilt),)))
