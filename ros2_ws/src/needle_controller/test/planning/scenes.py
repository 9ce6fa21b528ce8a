"""Random obstacles between an entry and a target."""

from __future__ import annotations

import numpy as np

from needle_controller.planning.obstacles import Obstacle, Obstacles


def random_obstacles(rng: np.random.Generator, count: int, largest: float) -> Obstacles:
    """Return capsules with radii from 3 mm to `largest` [m], 20 to 70 mm ahead of the entry."""
    starts = rng.uniform([-0.012, -0.012, 0.02], [0.012, 0.012, 0.07], (count, 3))
    ends = starts + rng.normal(0.0, 0.008, (count, 3))
    pairs = zip(starts, ends, strict=True)
    return Obstacles([Obstacle(a, b, rng.uniform(0.003, largest)) for a, b in pairs])
