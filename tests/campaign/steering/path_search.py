"""Thorough search for a path through a scene, independent of the planner.

A tree of needles grows in steps of 1 mm: from the nearest needle that can reach a random point, a
new one is driven towards it for a random length, the bevel turned at its greatest rate; each new
needle is also driven to the target. With thousands of points it misses few existing paths
(probabilistically complete: LaValle and Kuffner 2001); a path that it finds certainly exists.
"""

# Compiled code accepts keywords slowly or not at all.
from __future__ import annotations

import math

import numpy as np

from needle_core.compiled import compiled
from needle_sim.needle.se3 import FloatArray

_STEP = 0.001
_HIT = 0.0005
"""Distance from the target that counts as reached [m]."""
_WIDE = 0.04
_LONGEST = 0.2


@compiled
def find_path(
    target: FloatArray,
    obstacles: FloatArray,
    curvature: float,
    turn_rate: float,
    clear: float,
    samples: int,
    seed: int,
) -> int:
    """Return the number of random points after which a path was found; -1 if none.

    Parameters
    ----------
    target : ndarray, shape (3,)
        In `rig`; the needle enters at its origin along z and bends to -y [m].
    obstacles : ndarray, shape (N, 7)
        Ends of the axis and radius of each capsule [m].
    curvature : float
        Curvature of the needle's path [1/m].
    turn_rate : float
        Largest turn of the bevel per inserted length [rad/m].
    clear : float
        Least distance from every obstacle [m].
    samples : int
        Largest number of random points.
    seed : int
        Seed of the points.
    """
    np.random.seed(seed)  # noqa: NPY002 - compiled code has no other
    # Position, heading, and direction of the bend.
    tree, length = np.empty((samples + 1, 9)), np.empty(samples + 1)
    tree[0] = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0])
    length[0] = 0.0
    count = 1
    state, point = np.empty(9), np.empty(3)
    for sample in range(samples + 1):
        if sample > 0:
            share = np.random.random()  # noqa: NPY002
            wide = _WIDE * min(1.0, 2.0 * min(share, 1.0 - share) + 0.2)
            for i in range(3):
                point[i] = target[i] * share
            point[0] += wide * (2.0 * np.random.random() - 1.0)  # noqa: NPY002
            point[1] += wide * (2.0 * np.random.random() - 1.0)  # noqa: NPY002
            node = _nearest(tree, count, point, curvature)
            if node < 0:
                continue
            state[:] = tree[node]
            longest = 0.005 + 0.035 * np.random.random()  # noqa: NPY002
            gone = _drive(state, point, longest, curvature, turn_rate, obstacles, clear)
            if gone < 0.0:
                continue
            tree[count], length[count] = state, length[node] + gone
            count += 1
        state[:] = tree[count - 1]
        left = _LONGEST - length[count - 1]
        if _drive(state, target, left, curvature, turn_rate, obstacles, clear) < 0.0:
            continue
        off = (state[0] - target[0]) ** 2 + (state[1] - target[1]) ** 2
        if off + (state[2] - target[2]) ** 2 <= _HIT**2:
            return sample
    return -1


@compiled
def _nearest(tree: FloatArray, count: int, point: FloatArray, curvature: float) -> int:
    best, least = -1, math.inf
    for k in range(count):
        x, y, z = point[0] - tree[k, 0], point[1] - tree[k, 1], point[2] - tree[k, 2]
        ahead = x * tree[k, 3] + y * tree[k, 4] + z * tree[k, 5]
        squared = x * x + y * y + z * z
        aside = math.sqrt(max(squared - ahead * ahead, 0.0))
        if ahead >= 0.003 and squared >= 2.0 * aside / curvature and squared < least:
            best, least = k, squared
    return best


@compiled
def _drive(
    state: FloatArray,
    point: FloatArray,
    longest: float,
    curvature: float,
    turn_rate: float,
    obstacles: FloatArray,
    clear: float,
) -> float:
    """Steer a needle towards a point; return its travel [m], -1 if it came too near."""
    gone = 0.0
    while gone < longest:
        x, y, z = point[0] - state[0], point[1] - state[1], point[2] - state[2]
        ahead = x * state[3] + y * state[4] + z * state[5]
        if ahead <= 1e-9:
            break
        step = min(_STEP, ahead)
        up = x * state[6] + y * state[7] + z * state[8]
        beside = (
            x * (state[4] * state[8] - state[5] * state[7])
            + y * (state[5] * state[6] - state[3] * state[8])
            + z * (state[3] * state[7] - state[4] * state[6])
        )
        turn = min(max(math.atan2(beside, up), -turn_rate * step), turn_rate * step)
        # A quarter of the turn, half the bend, and so on: to second order the helix.
        for part in range(2):
            _turn(state, 0.25 * turn if part == 0 else 0.5 * turn)
            _bend(state, 0.5 * step, curvature)
        _turn(state, 0.25 * turn)
        gone += step
        if not _is_clear(state, obstacles, clear):
            return -1.0
    return gone


@compiled
def _turn(state: FloatArray, angle: float) -> None:
    cosine, sine = math.cos(angle), math.sin(angle)
    x = state[4] * state[8] - state[5] * state[7]
    y = state[5] * state[6] - state[3] * state[8]
    z = state[3] * state[7] - state[4] * state[6]
    state[6] = cosine * state[6] + sine * x
    state[7] = cosine * state[7] + sine * y
    state[8] = cosine * state[8] + sine * z


@compiled
def _bend(state: FloatArray, length: float, curvature: float) -> None:
    angle = curvature * length
    sine, cosine = math.sin(angle), math.cos(angle)
    for i in range(3):
        heading, bend = state[3 + i], state[6 + i]
        state[i] += (sine * heading + (1.0 - cosine) * bend) / curvature
        state[3 + i] = cosine * heading + sine * bend
        state[6 + i] = cosine * bend - sine * heading


@compiled
def _is_clear(state: FloatArray, obstacles: FloatArray, clear: float) -> bool:
    for k in range(obstacles.shape[0]):
        squared = along = 0.0
        for i in range(3):
            axis = obstacles[k, 3 + i] - obstacles[k, i]
            squared += axis * axis
            along += axis * (state[i] - obstacles[k, i])
        share = min(max(along / squared, 0.0), 1.0) if squared > 0.0 else 0.0
        distance = 0.0
        for i in range(3):
            axis = obstacles[k, 3 + i] - obstacles[k, i]
            distance += (state[i] - obstacles[k, i] - share * axis) ** 2
        if distance < (obstacles[k, 6] + clear) ** 2:
            return False
    return True
