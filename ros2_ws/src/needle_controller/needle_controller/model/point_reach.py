"""Whether a needle can reach a point, and with how little insertion.

A needle of curvature kappa bends with anything from 0 (its bevel turned round and round) to kappa.
So it can reach what lies outside the circles of radius 1 / kappa that touch its heading, and the
soonest way there is an arc of kappa in the plane of heading and point, then straight on. All of it
is closed form, and exact but for the turning of the bevel, which is taken to need no insertion.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.model.reachability import LARGEST_PITCH, Reachability
from needle_controller.model.target_plane import RIG
from needle_core.errors import UserError


def point_from_message(frame_id: str, position: npt.ArrayLike) -> Array:
    """Return a target point, shape (3,), of `rig` [m].

    Raises
    ------
    UserError
        Another frame, or numbers that are not finite.
    """
    point = np.asarray(position, dtype=float)
    if frame_id != RIG:
        raise UserError(f"target_point is given in frame '{frame_id}', expected '{RIG}'")
    if not np.all(np.isfinite(point)):
        raise UserError(f"target_point is not finite: {point}")
    return point


def point_reachability(
    target: npt.ArrayLike,
    curvature: npt.ArrayLike,
    *,
    insertion: npt.ArrayLike,
    end: npt.ArrayLike,
    tolerance: float = 0.0,
) -> Reachability:
    """Return whether a point can still be reached in the insertion that is left.

    Parameters
    ----------
    target : array_like, shape (..., 3)
        In the tip's frame [m].
    curvature : array_like, shape (...)
        kappa [1/m].
    insertion, end : array_like, shape (...)
        Present insertion, and the one at which steering ends at the latest [m].
    tolerance : float
        Distance from the point that counts as there, small beside 1 / kappa [m].

    Returns
    -------
    Reachability
        The answer, and the least insertion at which the tip can be there; NaN where it never can.
    """
    depth = np.asarray(insertion, dtype=float) + least_insertion_to_point(
        target, curvature, tolerance=tolerance
    )
    return Reachability(np.asarray(depth <= np.asarray(end, dtype=float) + tolerance), depth)


def least_insertion_to_point(
    target: npt.ArrayLike, curvature: npt.ArrayLike, *, tolerance: float = 0.0
) -> Array:
    """Return the least insertion that brings a tip to a point, shape (...) [m]; NaN: none does.

    A point beside or behind the tip, or one for which the needle would have to turn by more than
    `LARGEST_PITCH`, counts as one that it cannot reach. Parameters as of `point_reachability`.
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
    """Check that a needle that is still out could be steered to a point.

    Parameters
    ----------
    point : array_like, shape (3,)
        In `rig` [m]: the needle enters at its origin, along z.
    curvature : float
        kappa [1/m].
    depth : float
        Insertion at which steering ends at the latest [m].

    Raises
    ------
    UserError
        The needle cannot come there: says why, and from where it could.
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
    """Return how far to the side a needle gets at a distance > 0 ahead of it [m]."""
    radius = 1.0 / curvature
    widest_arc = min(math.asin(min(ahead / radius, 1.0)), LARGEST_PITCH)
    straight = ahead - radius * math.sin(widest_arc)
    return radius * (1.0 - math.cos(widest_arc)) + straight * math.tan(widest_arc)
