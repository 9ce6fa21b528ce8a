"""A bare needle and graph paper: reflection of the lamp, and position of the lines."""

from __future__ import annotations

import numpy as np
import pytest

from needle_sim.camera.lighting import lamp_reflection
from needle_sim.camera.scenarios import MetalShaft


def test_a_shaft_reflects_where_its_normal_bisects_the_angle_and_not_where_it_bends_away() -> None:
    camera, lamp = np.array([0.5, 0.0, 0.05]), np.array([0.4, 0.25, 0.05])
    line = np.linspace(0.0, 0.1, 200)[:, np.newaxis] * [0.0, 0.0, 1.0]
    share, place = lamp_reflection(line, camera, lamp, MetalShaft())
    # Level with camera and lamp, and nowhere else as much.
    middle = int(np.argmax(share))
    assert line[middle, 2] == pytest.approx(0.05, abs=2e-3)
    assert share.max() == pytest.approx(1.0, abs=1e-3)
    assert share[0] < 0.9 * share.max()
    # The lamp is at y > 0, 0.56 rad from the camera: the normal is turned by half of that.
    turn = np.arctan2(0.25, 0.4) / 2.0
    side = np.cross([0.0, 0.0, 1.0], camera - line[middle])[1]
    assert place[middle] == pytest.approx(np.sign(side) * np.sin(turn), abs=0.02)
    # From the other side it is the other half.
    _, other = lamp_reflection(line, camera, lamp * [1.0, -1.0, 1.0], MetalShaft())
    assert other[middle] == pytest.approx(-place[middle], abs=1e-9)
    up = line + np.linspace(0.0, 1.0, 200)[:, np.newaxis] ** 2 * [0.03, 0.0, 0.0]
    assert lamp_reflection(up, camera, lamp, MetalShaft(spread=0.1))[0][-1] < 0.02
