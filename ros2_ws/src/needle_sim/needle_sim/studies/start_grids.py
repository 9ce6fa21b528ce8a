"""Starts of the needles of a study: the grid of [KC09] IV-A, in either convention, or random."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np

from needle_sim.needle.se3 import FloatArray
from needle_sim.studies import study_noise

POINTS = 10
"""Points of a grid along each coordinate."""


@dataclasses.dataclass(frozen=True)
class StartBounds:
    """Largest |x| [m], |pitch| and |roll| [rad] of a start."""

    x: float
    pitch: float
    roll: float

    @property
    def half_widths(self) -> FloatArray:
        """All three, in the order of a start."""
        return np.array([self.x, self.pitch, self.roll])


def endpoint_grid(bounds: StartBounds, draws: int, seed: int) -> FloatArray:
    """Return the 10 x 10 x 10 grid whose outermost points are the bounds."""
    return _grid(np.linspace(-1.0, 1.0, POINTS), bounds, draws)


def cell_grid(bounds: StartBounds, draws: int, seed: int) -> FloatArray:
    """Return the middles of the 10 x 10 x 10 cells that the bounds enclose."""
    return _grid((2.0 * np.arange(POINTS) + 1.0) / POINTS - 1.0, bounds, draws)


def random_starts(bounds: StartBounds, draws: int, seed: int) -> FloatArray:
    """Return as many starts as the grids have runs, uniform within the bounds, no two alike."""
    numbers = study_noise.uniform(seed, study_noise.START, 0, 0, POINTS**3 * draws)
    share = numbers[:, :3].astype(np.float64)
    return np.asarray((2.0 * share - 1.0) * bounds.half_widths)


GRIDS: Mapping[str, Callable[[StartBounds, int, int], FloatArray]] = {
    "endpoint": endpoint_grid,
    "cell": cell_grid,
    "random": random_starts,
}
"""Each takes bounds, draws and seed, and returns x [m], pitch, roll [rad], (1000 draws, 3)."""


def _grid(unit: FloatArray, bounds: StartBounds, draws: int) -> FloatArray:
    points = np.stack(np.meshgrid(unit, unit, unit, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.repeat(points * bounds.half_widths, draws, axis=0)
