"""Published laws that serve as references: sliding mode control and RRT replanning."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from needle_core.compiled import compiled
from needle_sim.needle.se3 import FloatArray


def sliding_mode_rate(target: ArrayLike, largest_rate: float) -> FloatArray:
    """Return the rotation of the base per inserted length, (...) [rad/m].

    Parameters
    ----------
    target : array_like, shape (..., 3)
        In the tip's frame, whose z is the heading and to whose -y the needle bends [m].
    largest_rate : float
        What it turns at [rad/m].
    """
    x, y, _ = np.moveaxis(np.asarray(target, dtype=float), -1, 0)
    return np.asarray(largest_rate * np.sign(np.arctan2(x, -y)))


# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917


SAMPLES = 400
"""Random points of a plan."""
_LONGEST = 0.02
"""Of one arc of the tree [m]."""
_TO_TARGET = 0.1
"""Share of the random points that are the target."""
_APART = 0.001
"""Of the points of an arc that are looked at [m]."""


class DutyCycle:
    """Makes a bevel bend as a plan wants it, by spinning part of the way; many needles at once.

    Parameters
    ----------
    largest_rate : float
        What the base turns at, at most, per inserted length [rad/m].
    step_length : float
        Inserted length over which a command is held [m].
    """

    def __init__(self, largest_rate: float, step_length: float) -> None:
        self._limit = largest_rate * step_length
        self._step_length = step_length
        self._owed: FloatArray = np.zeros(())
        self._to_spin: FloatArray = np.zeros(())

    def rates(self, arcs: FloatArray) -> FloatArray:
        """Return the rotation of each base per inserted length [rad/m].

        Parameters
        ----------
        arcs : ndarray, shape (N, 3)
            See `plan`; the share of the curvature is that of the whole cycle.
        """
        self._owed = self._owed + (1.0 - arcs[:, 2]) * self._limit
        starts = (self._to_spin <= 0.0) & (self._owed >= math.pi)
        self._to_spin = np.where(starts, 2.0 * math.pi, self._to_spin)
        spins = self._to_spin > 0.0
        spun = np.minimum(self._to_spin, self._limit)
        self._to_spin = self._to_spin - spun
        self._owed = self._owed - spun
        aimed = np.arctan2(arcs[:, 0], -arcs[:, 1])
        turns = np.where(spins, spun, np.clip(aimed, -self._limit, self._limit))
        return np.asarray(turns / self._step_length)


@compiled
def plan(
    position: FloatArray,
    rotation: FloatArray,
    target: FloatArray,
    obstacles: FloatArray,
    curvature: float,
    clear: float,
    chance: FloatArray,
    arc: FloatArray,
) -> bool:
    """Write the first arc of a path to a target; return whether there is one.

    Parameters
    ----------
    position, rotation : ndarray, shape (3,), (3, 3)
        Pose of the tip, whose z is the heading and to whose -y it bends [m].
    target : ndarray, shape (3,)
        Where it is to go [m].
    obstacles : ndarray, shape (M, 7)
        Ends of the axis and radius of each capsule [m].
    curvature : float
        Of the needle's path [1/m].
    clear : float
        Distance to keep from each surface [m].
    chance : ndarray, shape (S, 4)
        Uniform random numbers in [0, 1) for each random point.
    arc : ndarray, shape (3,), written
        x and y of the direction that it bends to, in the tip's frame, and its curvature as a share
        of the needle's.
    """
    count = chance.shape[0] + 1
    places, headings = np.empty((count, 3)), np.empty((count, 3))
    firsts, lengths = np.zeros(count, dtype=np.int64), np.zeros(count)
    places[0], headings[0] = position, rotation[:, 2]
    nodes, best, shortest = 1, -1, math.inf
    bend, end, heading = np.empty(3), np.empty(3), np.empty(3)
    far_ahead = headings[0] @ (target - position)
    for k in range(count):
        # The newest node tries the target first; from the root on, whenever one was added.
        node = nodes - 1
        far = arc_to(places[node], headings[node], target, curvature, bend)
        if lengths[node] + far < shortest and is_clear(
            places[node], headings[node], bend, far, obstacles, clear
        ):
            best, shortest = node, lengths[node] + far
        if best == 0 or k == chance.shape[0]:
            break
        goal = target.copy()
        if chance[k, 3] >= _TO_TARGET:
            # Ahead of the tip and within what its tightest arcs reach there.
            ahead = chance[k, 2] * far_ahead
            aside = 0.5 * curvature * ahead * ahead
            across = aside * (2.0 * chance[k, 0] - 1.0), aside * (2.0 * chance[k, 1] - 1.0)
            goal = position + rotation @ np.array([across[0], across[1], ahead])
        nearest, node = math.inf, -1
        for n in range(nodes):
            far = arc_to(places[n], headings[n], goal, curvature, bend)
            if far < nearest:
                nearest, node = far, n
        if node < 0:
            continue
        arc_to(places[node], headings[node], goal, curvature, bend)
        far = min(nearest, _LONGEST)
        if not is_clear(places[node], headings[node], bend, far, obstacles, clear):
            continue
        move(places[node], headings[node], bend, far, end, heading)
        places[nodes], headings[nodes] = end, heading
        firsts[nodes] = nodes if node == 0 else firsts[node]
        lengths[nodes] = lengths[node] + far
        nodes += 1
    if best < 0:
        return False
    aim = target if best == 0 else places[firsts[best]]
    arc_to(places[0], headings[0], aim, curvature, bend)
    size = math.sqrt(bend[0] ** 2 + bend[1] ** 2 + bend[2] ** 2)
    arc[:] = bend @ rotation
    arc[2] = min(size / curvature, 1.0)
    return True


@compiled
def arc_to(
    place: FloatArray, heading: FloatArray, goal: FloatArray, curvature: float, bend: FloatArray
) -> float:
    """Return the length of the arc to a point [m], infinite where none leads there.

    Parameters
    ----------
    place, heading, goal : ndarray, shape (3,)
        Begin, direction there, and end [m].
    curvature : float
        What it may have at most [1/m].
    bend : ndarray, shape (3,), written
        Its curvature times the direction that it bends to [1/m].
    """
    way = goal - place
    ahead = way @ heading
    square = way @ way
    bend[:] = 2.0 / max(float(square), 1e-30) * (way - ahead * heading)
    size = math.sqrt(bend @ bend)
    if ahead <= 0.0 or size > curvature:
        return math.inf
    chord = math.sqrt(square)
    half = 0.5 * size * chord
    return float(chord * math.asin(half) / half) if half > 1e-9 else float(chord)


@compiled
def move(
    place: FloatArray,
    heading: FloatArray,
    bend: FloatArray,
    length: float,
    end: FloatArray,
    end_heading: FloatArray,
) -> None:
    """Write where an arc of a curvature `bend` leads after a length, and its direction there."""
    size = math.sqrt(bend @ bend)
    angle = size * length
    if angle < 1e-9:
        end[:], end_heading[:] = place + length * heading, heading
        return
    aside = bend / size
    end[:] = place + (math.sin(angle) * heading + (1.0 - math.cos(angle)) * aside) / size
    end_heading[:] = math.cos(angle) * heading + math.sin(angle) * aside


@compiled
def is_clear(
    place: FloatArray,
    heading: FloatArray,
    bend: FloatArray,
    length: float,
    obstacles: FloatArray,
    clear: float,
) -> bool:
    """Return whether an arc, see `move`, keeps its distance from all obstacles."""
    if not math.isfinite(length):
        return False
    point, direction = np.empty(3), np.empty(3)
    steps = math.ceil(length / _APART)
    for k in range(1, steps + 1):
        move(place, heading, bend, length * k / steps, point, direction)
        for m in range(obstacles.shape[0]):
            start, axis = obstacles[m, :3], obstacles[m, 3:6] - obstacles[m, :3]
            along = (point - start) @ axis / max(float(axis @ axis), 1e-30)
            off = point - start - min(max(float(along), 0.0), 1.0) * axis
            if math.sqrt(off @ off) - obstacles[m, 6] < clear:
                return False
    return True
