"""Published reference laws: sliding mode control, and RRT with replanning at every step.

Sliding mode: D. C. Rucker et al., "Sliding Mode Control of Steerable Needles", IEEE Trans. Robotics
29(5), 2013: the base always rotates at its maximum rate, towards the side of the bend on which the
target lies. It needs neither curvature nor gains, but the whole pose of the tip.

RRT: S. Patil, R. Alterovitz, "Interactive motion planning for steerable needles in 3D environments
with obstacles" (BioRob 2010); G. J. Vrooijink et al., "Needle path planning and steering in a
three-dimensional non-static environment using two-dimensional ultrasound images" (IJRR 2014). A
tree of arcs with any curvature up to the needle's grows towards random points; a point is connected
to the nearest node from which such an arc reaches it (reachability-guided sampling). Duty-cycled
spinning realizes smaller curvatures.
"""

# Compiled functions do not support keyword arguments well.
# ruff: noqa: PLR0917
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
        Target in the tip frame: z is the heading, the needle bends towards -y [m].
    largest_rate : float
        Maximum rotation rate [rad/m].
    """
    x, y, _ = np.moveaxis(np.asarray(target, dtype=float), -1, 0)
    return np.asarray(largest_rate * np.sign(np.arctan2(x, -y)))


SAMPLES = 400
"""Number of random points per plan."""
_MAX_ARC = 0.02
"""Maximum length of an arc of the tree [m]."""
_TARGET_SHARE = 0.1
"""Share of the random points that equal the target."""
_CHECK_SPACING = 0.001
"""Spacing of collision checks along an arc [m]."""


class DutyCycle:
    """Duty-cycled spinning that realizes the curvatures of a plan, for many needles at once.

    Parameters
    ----------
    largest_rate : float
        Maximum rotation of the base per inserted length [rad/m].
    step_length : float
        Inserted length per command [m].
    """

    def __init__(self, largest_rate: float, step_length: float) -> None:
        self._limit = largest_rate * step_length
        self._step_length = step_length
        self._pending_spin: FloatArray = np.zeros(())
        self._remaining_spin: FloatArray = np.zeros(())

    def rates(self, arcs: FloatArray) -> FloatArray:
        """Return the rotation of each base per inserted length [rad/m].

        Parameters
        ----------
        arcs : ndarray, shape (N, 3)
            See `plan`; the share of the curvature is the mean over a cycle.
        """
        self._pending_spin = self._pending_spin + (1.0 - arcs[:, 2]) * self._limit
        starts = (self._remaining_spin <= 0.0) & (self._pending_spin >= math.pi)
        self._remaining_spin = np.where(starts, 2.0 * math.pi, self._remaining_spin)
        spins = self._remaining_spin > 0.0
        spun = np.minimum(self._remaining_spin, self._limit)
        self._remaining_spin = self._remaining_spin - spun
        self._pending_spin = self._pending_spin - spun
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
    """Write the first arc of a path to a target; return whether a path was found.

    Parameters
    ----------
    position, rotation : ndarray, shape (3,), (3, 3)
        Pose of the tip: z is the heading, the needle bends towards -y [m].
    target : ndarray, shape (3,)
        Target point [m].
    obstacles : ndarray, shape (M, 7)
        Ends of the axis and radius of each capsule [m].
    curvature : float
        Curvature of the needle's path [1/m].
    clear : float
        Clearance from each obstacle [m].
    chance : ndarray, shape (S, 4)
        Uniform random numbers in [0, 1) for each random point.
    arc : ndarray, shape (3,), written
        x and y of the bending direction in the tip frame, and the curvature as a share of the
        needle's.
    """
    count = chance.shape[0] + 1
    places, headings = np.empty((count, 3)), np.empty((count, 3))
    firsts, lengths = np.zeros(count, dtype=np.int64), np.zeros(count)
    places[0], headings[0] = position, rotation[:, 2]
    nodes, best, shortest = 1, -1, math.inf
    bend, end, heading = np.empty(3), np.empty(3), np.empty(3)
    far_ahead = headings[0] @ (target - position)
    for k in range(count):
        # Try to connect the newest node, first the root, with the target.
        node = nodes - 1
        far = arc_to(places[node], headings[node], target, curvature, bend)
        if lengths[node] + far < shortest and is_clear(
            places[node], headings[node], bend, far, obstacles, clear
        ):
            best, shortest = node, lengths[node] + far
        if best == 0 or k == chance.shape[0]:
            break
        goal = target.copy()
        if chance[k, 3] >= _TARGET_SHARE:
            # Sample ahead of the tip, within the reach of its tightest arcs.
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
        far = min(nearest, _MAX_ARC)
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
    """Return the length of the arc to a point [m]; infinite if the point is not reachable.

    Parameters
    ----------
    place, heading, goal : ndarray, shape (3,)
        Start, heading at the start, and end of the arc [m].
    curvature : float
        Maximum curvature [1/m].
    bend : ndarray, shape (3,), written
        Curvature times bending direction [1/m].
    """
    offset = goal - place
    ahead = offset @ heading
    square = offset @ offset
    bend[:] = 2.0 / max(float(square), 1e-30) * (offset - ahead * heading)
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
    """Write the end of an arc with curvature vector `bend`, and the heading there."""
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
    """Return whether an arc, see `move`, keeps the clearance from all obstacles."""
    if not math.isfinite(length):
        return False
    point, direction = np.empty(3), np.empty(3)
    steps = math.ceil(length / _CHECK_SPACING)
    for k in range(1, steps + 1):
        move(place, heading, bend, length * k / steps, point, direction)
        for m in range(obstacles.shape[0]):
            start, axis = obstacles[m, :3], obstacles[m, 3:6] - obstacles[m, :3]
            along = (point - start) @ axis / max(float(axis @ axis), 1e-30)
            off = point - start - min(max(float(along), 0.0), 1.0) * axis
            if math.sqrt(off @ off) - obstacles[m, 6] < clear:
                return False
    return True
