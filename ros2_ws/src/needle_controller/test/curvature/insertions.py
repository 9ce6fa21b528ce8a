"""Tips of pure insertions."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from needle_controller.model.arrays import Array
from needle_sim.needle.plant import NeedlePlant

RADIUS = 0.122
STEP = 0.001


def insertion_tips(
    count: int,
    arc: float,
    rng: Generator,
    *,
    heading_std: float = math.radians(5.0),
    turn: float = 0.0,
) -> tuple[Array, Array]:
    """Return exact tips (count, K, 3) of insertions at any roll, and their insertions.

    The base turns once, half-way, by `turn`.
    """
    vectors = rng.normal(0.0, heading_std, (count, 3)) * [1.0, 1.0, 0.0]
    rolls = np.zeros((count, 3))
    rolls[:, 2] = rng.uniform(-np.pi, np.pi, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    turned = Rotation.from_rotvec(vectors) * Rotation.from_rotvec(rolls)
    poses[:, :3, :3] = turned.as_matrix()
    plant = NeedlePlant(poses, curvature=1.0 / RADIUS)
    insertion = np.arange(0.0, arc + 1e-9, STEP)
    tips = [plant.T_rig_tip[:, :3, 3]]
    for k in range(1, len(insertion)):
        plant.advance(STEP, turn if k == len(insertion) // 2 else 0.0)
        tips.append(plant.T_rig_tip[:, :3, 3])
    return np.stack(tips, axis=1), insertion


def uniform(tips: Array, rng: Generator) -> Array:
    return np.asarray(tips + rng.uniform(-1e-3, 1e-3, tips.shape))
