"""Points by which a path may pass obstacles: on rings around them, then everywhere."""

from __future__ import annotations

import math

import numpy as np

from needle_controller.model.arrays import Array
from needle_core.compiled import compiled

_AROUND = 12
"""Points of a ring."""
_SHORTEST_AXIS = 1e-6
_SHORTEST, _LONGEST = 0.005, 0.04
_WIDEST = 0.04
"""Distance from the straight way up to which points are strewn [m]."""


@compiled
def candidate_points(
    tip: Array, target: Array, table: Array, distances: Array, strewn: int
) -> Array:
    """Return points for a path from a tip to its target, those beside obstacles first.

    Rings lie across the straight way, around the place of an obstacle's axis that is nearest to it
    and, for a capsule, around both ends of the axis; each also a radius before that place, where a
    bend past the obstacle begins. The other points are a Halton sequence (bases 2, 3, 5) in a tube
    around the straight way, thin at both ends.

    Parameters
    ----------
    tip, target : ndarray, shape (3,)
        Where from and where to [m].
    table : ndarray, shape (N, 7)
        See `Obstacles`.
    distances : ndarray, shape (D,)
        Of the rings from an obstacle's surface [m].
    strewn : int
        How many points beside the rings.

    Returns
    -------
    ndarray, shape (M, 4)
        The points, and how far a path goes towards each at most [m].
    """
    points = np.empty((6 * _AROUND * table.shape[0] * distances.shape[0] + strewn, 4))
    way = target - tip
    way_length = math.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
    way = way / way_length
    side = np.zeros(3)
    side[np.argmin(np.abs(way))] = 1.0
    first = np.cross(way, side)
    first /= math.sqrt(first[0] ** 2 + first[1] ** 2 + first[2] ** 2)
    second = np.cross(way, first)
    count = 0
    for distance in distances:
        for k in range(table.shape[0]):
            start, end, radius = table[k, :3], table[k, 3:6], table[k, 6]
            axis = end - start
            places = 1
            share = 0.5
            squared = axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2
            if squared > _SHORTEST_AXIS**2:
                places = 3
                along_way = axis[0] * way[0] + axis[1] * way[1] + axis[2] * way[2]
                across = axis - along_way * way
                flat = across[0] ** 2 + across[1] ** 2 + across[2] ** 2
                if flat > 1e-6 * squared:
                    there = tip - start
                    nearest = there[0] * across[0] + there[1] * across[1] + there[2] * across[2]
                    share = min(max(nearest / flat, 0.0), 1.0)
            for place in range(places):
                at = (share, 0.0, 1.0)[place]
                for before in (0.0, 1.0):
                    middle = start + at * axis - before * radius * way
                    off = middle - tip
                    along = off[0] * way[0] + off[1] * way[1] + off[2] * way[2]
                    if not 0.0 < along < way_length:
                        continue
                    for i in range(_AROUND):
                        angle = 2.0 * math.pi * i / _AROUND
                        out = radius + distance
                        points[count, :3] = (
                            middle + out * math.cos(angle) * first + out * math.sin(angle) * second
                        )
                        points[count, 3] = math.inf
                        count += 1
    for i in range(1, strewn + 1):
        along = _halton(i, 2)
        wide = _WIDEST * min(1.0, 0.1 + 2.0 * min(along, 1.0 - along))
        out, angle = wide * math.sqrt(_halton(i, 3)), 2.0 * math.pi * _halton(i, 5)
        points[count, :3] = (
            tip
            + along * way_length * way
            + out * math.cos(angle) * first
            + out * math.sin(angle) * second
        )
        points[count, 3] = _SHORTEST + (_LONGEST - _SHORTEST) * _halton(i, 7)
        count += 1
    return points[:count]


@compiled
def _halton(index: int, base: int) -> float:
    value, part = 0.0, 1.0
    while index > 0:
        part /= base
        value += part * (index % base)
        index //= base
    return value
