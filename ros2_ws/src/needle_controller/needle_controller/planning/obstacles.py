"""Obstacles that the needle must not touch: spheres and capsules in `rig`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.planning.segments import segment_distance
from needle_core.errors import UserError
from needle_core.settings.bounds import check_bounds

MOST_OBSTACLES = 64
FARTHEST = 1.0
"""Largest size of a coordinate [m]: what is farther off is given in another unit."""
LARGEST_RADIUS = 0.2


@dataclasses.dataclass(frozen=True)
class Obstacle:
    """A capsule: all within a radius of a segment; a sphere where the segment is a point.

    Attributes
    ----------
    start, end : tuple of float
        Ends of the axis in `rig` [m].
    radius : float
        Of the capsule [m].
    """

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float


class Obstacles:
    """A checked set of obstacles.

    Parameters
    ----------
    obstacles : sequence of Obstacle
        In `rig`; what is told of one names it by its place, from 1 on.

    Attributes
    ----------
    table : ndarray, shape (N, 7)
        Ends of the axis and radius of each [m].

    Raises
    ------
    UserError
        More than `MOST_OBSTACLES`, or one that is not finite or out of bounds.
    """

    def __init__(self, obstacles: Sequence[Obstacle] = ()) -> None:
        if len(obstacles) > MOST_OBSTACLES:
            raise UserError(f"{len(obstacles)} obstacles, wants at most {MOST_OBSTACLES}")
        for number, obstacle in enumerate(obstacles, start=1):
            for axis, value in zip("xyzxyz", (*obstacle.start, *obstacle.end), strict=True):
                check_bounds(f"{axis} of obstacle {number}", value, -FARTHEST, FARTHEST, "m")
            name = f"radius of obstacle {number}"
            check_bounds(name, obstacle.radius, 1e-5, LARGEST_RADIUS, "m")
        rows = [[*one.start, *one.end, one.radius] for one in obstacles]
        self.table: Array = np.array(rows, dtype=float).reshape(-1, 7)

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.table)

    def clearance(self, position: npt.ArrayLike) -> float:
        """Return a point's distance from the nearest surface, < 0 inside [m]; inf without any.

        Parameters
        ----------
        position : array_like, shape (3,)
            In `rig` [m].
        """
        point = np.asarray(position, dtype=float)
        nearest = math.inf
        for row in self.table:
            distance = segment_distance(point, point, row[:3], row[3:6])
            nearest = min(nearest, float(distance - row[6]))
        return nearest
