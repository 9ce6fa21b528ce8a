"""Reachability of a plane or a point, and the smallest depth at which it can be reached.

In the reduced model (5) of [KC09], with a free choice of the roll, the pitch changes by at most
kappa per inserted length, and x by sin(pitch): a double integrator with |x''| <= kappa to first
order. The shortest path into the plane is an arc at roll +90 deg, then one at -90 deg (or vice
versa), with a straight part at the largest pitch between them if that limit is met. Arcs at roll
+-90 deg have a closed form: over a length l the pitch changes by kappa l, and from pitch b0 to b1 x
changes by +-(cos b0 - cos b1) / kappa.

A needle bends with a curvature from 0 (the bevel turns continuously) to kappa. So it reaches the
points outside the circles of radius 1 / kappa that touch its heading; the shortest path to one is
an arc of kappa in the plane of heading and point, then a straight line.

All this neglects the insertion during which the roll turns, so the depths are lower bounds for
every law.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.model.target_plane import TargetPlane
from needle_core.errors import UserError

LARGEST_PITCH = math.radians(80.0)
"""Largest pitch along the path: beyond it the coordinates (3) fail; no needle should go there."""
SHORTEST_CHECKED_DEPTH = 0.12
"""Depth of the insertions of [KC09] IV-B [m]; shorter runs count as parts of one."""


def least_insertion(
    reduced: npt.ArrayLike, curvature: npt.ArrayLike, *, tolerance: float = 0.0
) -> Array:
    """Return the least insertion after which the needle can lie in the plane, at pitch 0.

    Parameters
    ----------
    reduced : array_like, shape (..., 3)
        x [m], pitch, roll [rad]; the roll does not matter.
    curvature : array_like, shape (...)
        kappa [1/m].
    tolerance : float
        Distance from the plane that counts as in it [m].

    Returns
    -------
    ndarray, shape (...)
        Least insertion [m]; NaN where the state is NaN.
    """
    reduced, curvature = np.asarray(reduced, dtype=float), np.asarray(curvature, dtype=float)
    x, pitch = reduced[..., 0], reduced[..., 1]
    # Position after levelling out immediately.
    level_x = x + np.sign(pitch) * (1.0 - np.cos(pitch)) / curvature
    # Distance to the band around the plane; below it, the needle goes up first (+x).
    excess = level_x - np.clip(level_x, -tolerance, tolerance)
    up = np.where(excess > 0.0, -1.0, 1.0)
    distance, start = up * (x - (level_x - excess)), up * pitch
    # Up to the pitch `top`, then level out: x gains (cos start - 2 cos top + 1) / kappa.
    cosine = 0.5 * (1.0 + np.cos(start) + curvature * distance)
    limit = np.maximum(LARGEST_PITCH, start)
    top = np.minimum(np.arccos(np.clip(cosine, -1.0, 1.0)), limit)
    top = np.maximum(top, start)
    short = 2.0 * (np.cos(top) - cosine) / curvature
    straight = np.maximum(short, 0.0) / np.sin(limit)
    length = (2.0 * top - start) / curvature + straight
    level = np.abs(pitch) / curvature
    return np.asarray(np.where(np.abs(excess) <= 0.0, level, length))


def check_plane(plane: TargetPlane, curvature: float, depth: float) -> None:
    """Check that a needle that is not yet inserted can be steered into a plane.

    Parameters
    ----------
    plane : TargetPlane
        The target plane.
    curvature : float
        kappa [1/m].
    depth : float
        Insertion at which steering ends [m]; at least `SHORTEST_CHECKED_DEPTH` is assumed.

    Raises
    ------
    UserError
        The plane is out of reach; the message gives the insertion that it needs.
    """
    offset, depth = plane.offset, max(depth, SHORTEST_CHECKED_DEPTH)
    pitch = float(np.arcsin(np.clip(plane.T_plane_rig[0, 2], -1.0, 1.0)))
    needed = float(least_insertion([-offset, pitch, 0.0], curvature))
    if needed > depth:
        raise UserError(
            f"target plane at {offset:.4g} m cannot be reached: with curvature {curvature:.4g} 1/m "
            f"it takes {needed:.4g} m of insertion, depth is {depth:.4g} m"
        )


def least_insertion_to_point(
    target: npt.ArrayLike, curvature: npt.ArrayLike, *, tolerance: float = 0.0
) -> Array:
    """Return the least insertion from a tip to a point, shape (...) [m]; NaN if out of reach.

    A point next to or behind the tip, or one for which the needle would have to turn by more than
    `LARGEST_PITCH`, counts as out of reach.

    Parameters
    ----------
    target : array_like, shape (..., 3)
        Point in the tip's frame [m].
    curvature : array_like, shape (...)
        kappa [1/m].
    tolerance : float
        Distance at which the point counts as reached, small compared with 1 / kappa [m].
    """
    target = np.asarray(target, dtype=float)
    radius = 1.0 / np.asarray(curvature, dtype=float)
    ahead = target[..., 2]
    inwards = radius - np.hypot(target[..., 0], target[..., 1])
    from_center = np.hypot(inwards, ahead)
    bend = np.arctan2(ahead, inwards) - np.arccos(np.minimum(radius / from_center, 1.0))
    straight = np.sqrt(np.maximum(from_center - radius, 0.0)) * np.sqrt(from_center + radius)
    near = np.hypot(ahead, inwards - radius) <= tolerance
    reached = (ahead > 0.0) & (from_center >= radius - tolerance) & (bend <= LARGEST_PITCH)
    length = np.where(reached, radius * bend + straight, np.nan)
    return np.asarray(np.where(near, np.maximum(ahead, 0.0), length))


def check_point(point: npt.ArrayLike, curvature: float, depth: float) -> None:
    """Check that a needle that is not yet inserted can be steered to a point.

    Parameters
    ----------
    point : array_like, shape (3,)
        Point in `rig` [m]; the needle enters at the origin, along z.
    curvature : float
        kappa [1/m].
    depth : float
        Insertion at which steering ends at the latest [m].

    Raises
    ------
    UserError
        The point is out of reach; the message says why and, if only sideways, which entry would do.
    """
    x, y, z = (float(value) for value in np.asarray(point, dtype=float))
    named = f"target point ({x:.4g}, {y:.4g}, {z:.4g}) m cannot be reached"
    if z <= 0.0:
        raise UserError(f"{named}: it is not ahead of the entry (+z)")
    needed = float(least_insertion_to_point([x, y, z], curvature))
    if math.isnan(needed):
        across, widest = math.hypot(x, y), widest_at(z, curvature)
        share = 1.0 - widest / across
        raise UserError(
            f"{named}: at this depth a needle of curvature {curvature:.4g} 1/m reaches "
            f"{widest:.4g} m sideways, not {across:.4g} m; from an entry at ({x * share:.4g}, "
            f"{y * share:.4g}) m instead of (0, 0) it can"
        )
    if needed > depth:
        raise UserError(f"{named}: it takes {needed:.4g} m of insertion, depth is {depth:.4g} m")


def widest_at(ahead: float, curvature: float) -> float:
    """Return the largest lateral offset that a needle reaches at a distance > 0 ahead of it [m]."""
    radius = 1.0 / curvature
    widest_arc = min(math.asin(min(ahead / radius, 1.0)), LARGEST_PITCH)
    straight = ahead - radius * math.sin(widest_arc)
    return radius * (1.0 - math.cos(widest_arc)) + straight * math.tan(widest_arc)
