"""Legs of a path: the bevel turns towards an aim, the needle follows an arc, then a straight line.

While the bevel turns at its largest rate, the tip follows a helix; then an arc of the needle's
curvature, until the aim is straight ahead; then the bevel alternates or spins, so that the mean
path is straight. Poses are (3, 4) arrays: the rotation's columns, then the position, in `rig`.
"""

# Numba functions take positional arguments: keywords are slow or unsupported.
# ruff: noqa: PLR0917
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from needle_controller.model.arrays import Array
from needle_core.compiled import compiled

_TURN_ITERATIONS = 10
_TURN_FOUND = 2e-3
_LARGEST_TURN = 1.3 * math.pi
"""Largest turn: a longer one is replaced by a turn in the other direction [rad]."""
_LONGEST_CHORD = 0.005
"""Longest chord [m], which is within 0.03 mm of an arc of 122 mm radius."""
_LONGEST_STRAIGHT = 0.01
MOST_POINTS = 96
_AHEAD = 1e-4
"""Lateral distance within which an aim counts as straight ahead [m]."""


class Leg(NamedTuple):
    """One leg of a path.

    Attributes
    ----------
    turn : float
        Turn of the bevel at the start of the leg [rad].
    turning, bend, straight : float
        Lengths of the helix during the turn, of the arc, and of the straight line [m].
    curvature : float
        Curvature of the arc [1/m].
    miss : float
        Distance by which the leg misses the aim; 0 if it leads there [m].
    gentle_miss : float
        The same for a share of the curvature [m].
    """

    turn: float
    turning: float
    bend: float
    straight: float
    curvature: float
    miss: float
    gentle_miss: float


@compiled
def advance_pose(pose: Array, length: float, turn: float, curvature: float, moved: Array) -> None:
    """Compute the pose after one advance: exp((V1 length + V2 turn)^) of [KC09] (2).

    Parameters
    ----------
    pose, moved : ndarray, shape (3, 4)
        Poses before and after; may be the same array.
    length : float
        Inserted length [m].
    turn : float
        Rotation of the tip about its axis [rad].
    curvature : float
        kappa [1/m].
    """
    x, z = curvature * length, turn
    q = x * x + z * z
    if q < 1e-8:
        a, b, c = 1.0 - q / 6.0, 0.5 - q / 24.0, 1.0 / 6.0 - q / 120.0
    else:
        angle = math.sqrt(q)
        a = math.sin(angle) / angle
        b = 2.0 * (math.sin(0.5 * angle) / angle) ** 2
        c = (1.0 - a) / q
    sx, sy, sz = c * x * z * length, -b * x * length, (1.0 - c * x * x) * length
    for i in range(3):
        r0, r1, r2 = pose[i, 0], pose[i, 1], pose[i, 2]
        moved[i, 3] = pose[i, 3] + r0 * sx + r1 * sy + r2 * sz
        moved[i, 0] = r0 * (1.0 - b * z * z) + r1 * a * z + r2 * b * x * z
        moved[i, 1] = -r0 * a * z + r1 * (1.0 - b * q) + r2 * a * x
        moved[i, 2] = r0 * b * x * z - r1 * a * x + r2 * (1.0 - b * x * x)


@compiled
def in_tip_axes(pose: Array, aim: Array) -> tuple[float, float, float]:
    """Return a point in the axes of a tip [m].

    Parameters
    ----------
    pose : ndarray, shape (3, 4)
        Pose of the tip.
    aim : ndarray, shape (3,)
        The point.
    """
    x, y, z = aim[0] - pose[0, 3], aim[1] - pose[1, 3], aim[2] - pose[2, 3]
    return (
        pose[0, 0] * x + pose[1, 0] * y + pose[2, 0] * z,
        pose[0, 1] * x + pose[1, 1] * y + pose[2, 1] * z,
        pose[0, 2] * x + pose[1, 2] * y + pose[2, 2] * z,
    )


@compiled
def leg_towards(pose: Array, aim: Array, curvature: float, share: float, turn_rate: float) -> Leg:
    """Return the leg from a tip to an aim.

    The turn after which the aim lies in the plane of the arc is found by iteration; the straight
    line is the tangent to the arc's circle through the aim, in closed form.

    Parameters
    ----------
    pose : ndarray, shape (3, 4)
        Pose of the tip.
    aim : ndarray, shape (3,)
        Position of the aim [m].
    curvature : float
        kappa [1/m].
    share : float
        Share of the curvature for `gentle_miss`.
    turn_rate : float
        Largest rotation of the bevel per inserted length [rad/m].
    """
    x, y, z = in_tip_axes(pose, aim)
    turn, change = 0.0, 0.0
    turned = np.empty((3, 4))
    first, aside, ahead = math.atan2(x, -y), math.hypot(x, y), z
    if aside > _AHEAD:
        change = first
        for _ in range(_TURN_ITERATIONS):
            turn += change
            if abs(turn) > _LARGEST_TURN:
                # The turn in the other direction is shorter.
                turn -= math.copysign(2.0 * math.pi, turn)
            advance_pose(pose, abs(turn) / turn_rate, turn, curvature, turned)
            x, y, z = in_tip_axes(turned, aim)
            change = math.atan2(x, -y)
            if abs(change) < _TURN_FOUND:
                break
    gentle = 2.0 * aside / (aside * aside + ahead * ahead)
    if abs(change) >= _TURN_FOUND and gentle < curvature * share and ahead > 0.0:
        # The aim is almost ahead and would be passed during the turn, so the bevel alternates.
        angle = 2.0 * math.atan2(aside, ahead)
        return Leg(first, 0.0, angle / gentle, 0.0, gentle, 0.0, 0.0)
    aside, turning = math.hypot(x, y), abs(turn) / turn_rate
    if z <= 0.0:
        return Leg(turn, turning, 0.0, 0.0, curvature, aside - z, aside - z)
    # An aim within the circle is missed by its distance from the circle.
    wider, radius = 1.0 / (curvature * share), 1.0 / curvature
    gentle_miss = max(wider - math.hypot(z, wider - aside), 0.0)
    center = math.hypot(z, radius - aside)
    miss, straight = max(radius - center, 0.0), math.sqrt(max(center**2 - radius**2, 0.0))
    angle = math.atan2(z, radius - aside) - math.atan2(straight, radius)
    return Leg(turn, turning, max(angle, 0.0) * radius, straight, curvature, miss, gentle_miss)


@compiled
def truncated(leg: Leg, longest: float) -> Leg:
    """Return a leg, cut off at a largest length [m]."""
    turning = min(leg.turning, longest)
    turn = leg.turn
    if turning < leg.turning:
        turn *= turning / leg.turning
    bend = min(leg.bend, longest - turning)
    straight = min(leg.straight, longest - turning - bend)
    return Leg(turn, turning, bend, straight, leg.curvature, leg.miss, leg.gentle_miss)


@compiled
def leg_length(leg: Leg) -> float:
    """Return the length of a leg [m]."""
    return leg.turning + leg.bend + leg.straight


@compiled
def trace_leg(
    pose: Array, leg: Leg, curvature: float, length: float, points: Array, end: Array
) -> int:
    """Compute the corners of a polyline along a leg; return their number.

    Parameters
    ----------
    pose : ndarray, shape (3, 4)
        Start of the leg.
    leg : Leg
        The leg.
    curvature : float
        kappa [1/m].
    length : float
        Length of the path up to the start [m].
    points : ndarray, shape (MOST_POINTS, 4), changed
        Corners, including the start, and the path's length there [m].
    end : ndarray, shape (3, 4), changed
        The tip's pose at the end.
    """
    _write_corner(points[0], pose, length)
    count = 1
    advance_pose(pose, 0.0, leg.turn if leg.turning == 0.0 else 0.0, 0.0, end)
    parts = (
        (leg.turning, leg.turn, curvature, _LONGEST_CHORD),
        (leg.bend, 0.0, leg.curvature, _LONGEST_CHORD),
        (leg.straight, 0.0, 0.0, _LONGEST_STRAIGHT),
    )
    for inserted, turn, bend, longest in parts:
        if inserted <= 0.0:
            continue
        pieces = min(math.ceil(inserted / longest), (MOST_POINTS - 1) // 3)
        for _ in range(pieces):
            advance_pose(end, inserted / pieces, turn / pieces, bend, end)
            length += inserted / pieces
            _write_corner(points[count], end, length)
            count += 1
    return count


@compiled
def _write_corner(point: Array, pose: Array, length: float) -> None:
    # Copy number by number: assigning a slice takes seconds to compile.
    for i in range(3):
        point[i] = pose[i, 3]
    point[3] = length
