"""Scenes with obstacles between a needle's entry and its target."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from needle_sim.needle.se3 import FloatArray

NEAREST, FARTHEST = 0.060, 0.120
"""Length of the arc to the target without obstacles [m]."""
LARGEST_CURVATURE_SHARE = 0.85
"""Largest curvature of that arc, relative to the needle's."""
MOST_OBSTACLES = 6
SMALLEST, LARGEST = 0.003, 0.010
"""Radius of an obstacle [m]."""
PITCH_BOUND, ROLL_BOUND = math.radians(1.0), math.radians(10.0)
"""Bounds of the uniform pitch and roll at the entry [rad]."""
_ASIDE = 0.012
"""Largest distance of its centre from the straight line, in x and y [m]."""
_FREE_BELOW, _FREE_AROUND = 0.012, 0.004
"""Clearance around the entry, and around the target and a depth of 15 mm [m]."""
_TRIES = 100


@dataclasses.dataclass(frozen=True)
class ObstacleScene:
    """A target behind obstacles, and the orientation of the needle at the entry.

    Attributes
    ----------
    target : ndarray, shape (3,)
        Position in `rig` [m].
    obstacles : ndarray, shape (N, 7)
        Ends of the axis and radius of each capsule [m]; the ends of a sphere are equal.
    pitch, roll : float
        Orientation at the entry, unknown to the controller [rad].
    """

    target: FloatArray
    obstacles: FloatArray
    pitch: float
    roll: float


def make_scene(seed: int, number: int, curvature: float) -> ObstacleScene:
    """Return a scene, which may have no path to the target.

    Parameters
    ----------
    seed, number : int
        Keys of the random numbers.
    curvature : float
        Curvature of the needle's path [1/m].
    """
    rng = np.random.default_rng([seed, number])
    length = rng.uniform(NEAREST, FARTHEST)
    bend = curvature * rng.uniform(0.0, LARGEST_CURVATURE_SHARE)
    around = rng.uniform(0.0, 2.0 * math.pi)
    across, ahead = (1.0 - math.cos(bend * length)) / bend, math.sin(bend * length) / bend
    target = np.array([across * math.cos(around), across * math.sin(around), ahead])
    rows = []
    for _ in range(rng.integers(1, MOST_OBSTACLES + 1)):
        for _ in range(_TRIES):
            row = _obstacle(rng, target)
            if (
                clearance(row[np.newaxis], np.zeros(3)) > _FREE_BELOW
                and clearance(row[np.newaxis], np.array([0.0, 0.0, 0.015])) > _FREE_AROUND
                and clearance(row[np.newaxis], target) > _FREE_AROUND
            ):
                rows.append(row)
                break
    pitch, roll = rng.uniform(-1.0, 1.0, 2) * [PITCH_BOUND, ROLL_BOUND]
    return ObstacleScene(target, np.array(rows).reshape(-1, 7), float(pitch), float(roll))


def clearance(obstacles: FloatArray, point: FloatArray) -> float:
    """Return a point's distance from the nearest surface [m], negative inside.

    Parameters
    ----------
    obstacles : ndarray, shape (N, 7)
        See `ObstacleScene`.
    point : ndarray, shape (3,)
        Position in `rig` [m].
    """
    if not len(obstacles):
        return math.inf
    start, axis = obstacles[:, :3], obstacles[:, 3:6] - obstacles[:, :3]
    squared = np.maximum(np.sum(axis * axis, axis=1), 1e-30)
    share = np.clip(np.sum((point - start) * axis, axis=1) / squared, 0.0, 1.0)
    nearest = start + share[:, np.newaxis] * axis
    return float(np.min(np.linalg.norm(nearest - point, axis=1) - obstacles[:, 6]))


def _obstacle(rng: np.random.Generator, target: FloatArray) -> FloatArray:
    middle = target * rng.uniform(0.25, 0.85)
    middle[:2] += rng.uniform(-_ASIDE, _ASIDE, 2)
    radius = rng.uniform(SMALLEST, LARGEST)
    half = np.zeros(3)
    if rng.random() < 0.5:
        half = rng.normal(size=3)
        half *= rng.uniform(0.005, 0.020) / np.linalg.norm(half)
    return np.array([*(middle - half), *(middle + half), radius])
