from __future__ import annotations

import numpy as np
import pytest
from numpy.random import default_rng

from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.needle.se3 import FloatArray
from needle_sim.needle.tissue import Torsion
from needle_sim.studies.needle_batch import NeedleBatch

STARTS = default_rng(5).uniform(-1.0, 1.0, (40, 3)) * [0.003, 0.4, 3.0]


def plant(starts: FloatArray, curvature: FloatArray, torsion: Torsion | None) -> NeedlePlant:
    poses = np.array([initial_pose(pitch, roll) for _, pitch, roll in starts])
    poses[:, 0, 3] = starts[:, 0]
    return NeedlePlant(poses, curvature=curvature, torsion=torsion)


# Up to 2 rad a step: both the series and the closed form beyond it.
@pytest.mark.parametrize("largest_turn", [1e-9, 0.5, 2.0])
@pytest.mark.parametrize(("play", "lag"), [(0.0, 0.0), (0.3, 0.0), (0.0, 0.008), (0.3, 0.008)])
def test_the_compiled_batch_is_the_plant(largest_turn: float, play: float, lag: float) -> None:
    rng = default_rng(6)
    curvature = rng.uniform(5.0, 10.0, len(STARTS))
    batch = NeedleBatch(STARTS, Torsion(play, lag))
    reference = plant(STARTS, curvature, Torsion(play, lag))
    for length in rng.uniform(0.0, 0.002, 100):
        turned = rng.uniform(-largest_turn, largest_turn, len(STARTS))
        batch.advance(length, turned, curvature)
        reference.advance(length, turned)
    np.testing.assert_allclose(batch.T_rig_tip, reference.T_rig_tip, atol=1e-12)
    np.testing.assert_array_equal(batch.tips, batch.T_rig_tip[:, :3, 3])
    np.testing.assert_array_equal(batch.x, batch.tips[:, 0])


def test_curvature_may_change_on_the_way() -> None:
    batch = NeedleBatch(STARTS)
    reference = plant(STARTS, np.asarray(8.0), None)
    for curvature in (8.0, 0.0, 12.0):
        reference.curvature = np.asarray(curvature)
        reference.advance(0.02, 0.1)
        batch.advance(0.02, 0.1, curvature)
    np.testing.assert_allclose(batch.T_rig_tip, reference.T_rig_tip, atol=1e-13)
