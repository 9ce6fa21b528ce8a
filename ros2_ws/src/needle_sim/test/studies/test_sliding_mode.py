"""The reference law for points: its sign, and the bound that its publication gives."""

from __future__ import annotations

import numpy as np
import pytest

from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.studies.sliding_mode import sliding_mode_rate

CURVATURE = 1.0 / 0.122
RATE = np.deg2rad(30.0) / 0.001


@pytest.mark.parametrize("aside", [(1.0, 0.0), (-1.0, 0.0), (0.5, -2.0), (-0.1, 1.0)])
def test_the_bevel_is_turned_the_shorter_way_to_the_target(aside: tuple[float, float]) -> None:
    plant = NeedlePlant(initial_pose(0.0, 0.0), curvature=CURVATURE)
    target = np.array([*aside, 50.0]) * 1e-3
    turn = float(sliding_mode_rate(target, RATE)) * 1e-4
    plant.advance(0.0, turn)
    bevel = -plant.T_rig_tip[:2, 1]
    towards = np.array(aside) / np.hypot(*aside)
    assert bevel @ towards > np.array([0.0, -1.0]) @ towards


def test_an_exact_needle_comes_as_near_as_published() -> None:
    """At 30 deg/mm and this curvature the bound is 0.41 mm, in steps far shorter than a turn."""
    target, length = np.array([0.006, 0.004, 0.09]), 1e-4
    plant = NeedlePlant(initial_pose(0.02, 0.3), curvature=CURVATURE)
    for _ in range(2000):
        pose = plant.T_rig_tip
        ahead = pose[:3, :3].T @ (target - pose[:3, 3])
        if ahead[2] <= 0.0:
            break
        plant.advance(length, float(sliding_mode_rate(ahead, RATE)) * length)
    assert np.linalg.norm(plant.T_rig_tip[:3, 3] - target) < 0.00041
