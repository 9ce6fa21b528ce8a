from __future__ import annotations

import numpy as np
import pytest

from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.needle.tissue import Torsion
from needle_sim.studies.needles import NeedleBatch


# Up to 2 rad per step: both the series and the closed form beyond it.
@pytest.mark.parametrize(
    ("largest_turn", "torsion"), [(1e-9, (0.0, 0.0)), (0.5, (0.0, 0.0)), (2.0, (0.3, 0.008))]
)
def test_the_compiled_batch_is_the_plant(largest_turn: float, torsion: tuple[float, float]) -> None:
    rng = np.random.default_rng(6)
    starts = rng.uniform(-1.0, 1.0, (20, 3)) * [0.003, 0.4, 3.0]
    poses = np.array([initial_pose(pitch, roll) for _, pitch, roll in starts])
    poses[:, 0, 3] = starts[:, 0]
    batch = NeedleBatch(starts, Torsion(*torsion))
    reference = NeedlePlant(poses, curvature=0.0, torsion=Torsion(*torsion))
    for length in rng.uniform(0.0, 0.002, 30):
        turned = rng.uniform(-largest_turn, largest_turn, 20)
        # The curvature may change during the insertion.
        reference.curvature = rng.uniform(0.0, 12.0, 20)
        batch.advance(length, turned, reference.curvature)
        reference.advance(length, turned)
    np.testing.assert_allclose(batch.T_rig_tip, reference.T_rig_tip, atol=1e-12)
    np.testing.assert_array_equal(batch.tips, batch.T_rig_tip[:, :3, 3])
    np.testing.assert_array_equal(batch.x, batch.tips[:, 0])
    np.testing.assert_allclose(np.sin(batch.pitch), batch.T_rig_tip[:, 0, 2], atol=1e-12)
