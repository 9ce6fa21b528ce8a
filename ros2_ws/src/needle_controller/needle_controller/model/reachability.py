"""Reachability of the target plane, and the smallest depth at which the needle can lie in it.

In the reduced model (5) of [KC09], with a free choice of the roll, the pitch changes by at most
kappa per inserted length, and x by sin(pitch): a double integrator with |x''| <= kappa to first
order. The shortest path into the plane is an arc at roll +90 deg, then one at -90 deg (or vice
versa), with a straight part at the largest pitch between them if that limit is met. Arcs at roll
+-90 deg have a closed form: over a length l the pitch changes by kappa l, and from pitch b0 to b1 x
changes by +-(cos b0 - cos b1) / kappa. This neglects the insertion during which the roll turns, so
the depths are lower bounds for every law.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_core.errors import OutOfBoundsError, UserError

LARGEST_PITCH = math.radians(80.0)
"""Largest pitch on the way: beyond it the coordinates (3) fail, and no needle should go there."""


@dataclasses.dataclass(frozen=True)
class Reachability:
    """Result for a plane or a point.

    Attributes
    ----------
    reachable : ndarray of bool, shape (...)
        Whether the needle can be there at the final insertion.
    depth : ndarray, shape (...)
        Smallest insertion at which it can be there [m].
    """

    reachable: npt.NDArray[np.bool_]
    depth: Array


def reachability(
    reduced: npt.ArrayLike,
    curvature: npt.ArrayLike,
    *,
    insertion: npt.ArrayLike,
    end: npt.ArrayLike,
    tolerance: float = 0.0,
) -> Reachability:
    """Return whether the plane can be reached within the remaining insertion.

    Parameters
    ----------
    reduced : array_like, shape (..., 3)
        x [m], pitch, roll [rad]; the roll does not matter.
    curvature : array_like, shape (...)
        kappa [1/m].
    insertion, end : array_like, shape (...)
        Present and final insertion [m].
    tolerance : float
        Distance from the plane that counts as in it [m].

    Returns
    -------
    Reachability
        Whether it can, and the smallest insertion at which it can.

    Raises
    ------
    OutOfBoundsError
        A curvature, pitch or tolerance out of bounds.
    """
    insertion = np.asarray(insertion, dtype=float)
    depth = insertion + least_insertion(reduced, curvature, tolerance=tolerance)
    return Reachability(np.asarray(depth <= np.asarray(end, dtype=float)), depth)


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
        [m]; NaN where the state is.

    Raises
    ------
    OutOfBoundsError
        A curvature, pitch or tolerance out of bounds.
    """
    reduced, curvature = np.asarray(reduced, dtype=float), np.asarray(curvature, dtype=float)
    _check_curvature(curvature)
    if not 0.0 <= tolerance < math.inf:
        raise OutOfBoundsError("tolerance", tolerance, 0.0, math.inf, "m")
    x, pitch = reduced[..., 0], reduced[..., 1]
    steepest = np.abs(pitch[np.isfinite(pitch)])
    if np.any(steepest >= 0.5 * np.pi):
        worst = float(np.max(steepest))
        raise OutOfBoundsError("|pitch|", worst, 0.0, 0.5 * math.pi, "rad")
    # Position after levelling out at once.
    level_x = x + np.sign(pitch) * (1.0 - np.cos(pitch)) / curvature
    # Distance to the band around the plane; below it, the needle goes up first (+x).
    way = level_x - np.clip(level_x, -tolerance, tolerance)
    up = np.where(way > 0.0, -1.0, 1.0)
    distance, start = up * (x - (level_x - way)), up * pitch
    # Up to the pitch `top`, then level out: x gains (cos start - 2 cos top + 1) / kappa.
    cosine = 0.5 * (1.0 + np.cos(start) + curvature * distance)
    limit = np.maximum(LARGEST_PITCH, start)
    top = np.minimum(np.arccos(np.clip(cosine, -1.0, 1.0)), limit)
    top = np.maximum(top, start)
    short = 2.0 * (np.cos(top) - cosine) / curvature
    straight = np.maximum(short, 0.0) / np.sin(limit)
    length = (2.0 * top - start) / curvature + straight
    level = np.abs(pitch) / curvature
    return np.asarray(np.where(np.abs(way) <= 0.0, level, length))


def farthest_offsets(
    pitch: npt.ArrayLike, curvature: npt.ArrayLike, length: npt.ArrayLike
) -> tuple[Array, Array]:
    """Return the range of planes that can be reached within an insertion.

    Parameters
    ----------
    pitch : array_like, shape (...)
        Pitch of the needle in the planes' coordinates [rad].
    curvature : array_like, shape (...)
        kappa [1/m].
    length : array_like, shape (...)
        Remaining insertion, >= 0 [m].

    Returns
    -------
    lowest, highest : ndarray, shape (...)
        Offsets of planes from the tip along their x axis [m]; NaN if the length is too short for
        levelling out.

    Raises
    ------
    OutOfBoundsError
        A curvature out of bounds.
    """
    pitch, curvature = np.asarray(pitch, dtype=float), np.asarray(curvature, dtype=float)
    length = np.asarray(length, dtype=float)
    _check_curvature(curvature)
    highest = _highest(pitch, curvature, length)
    return -_highest(-pitch, curvature, length), highest


def check_offset(offset: float, curvature: float, depth: float, pitch: float = 0.0) -> None:
    """Check that a needle that is still out can reach a plane.

    Parameters
    ----------
    offset : float
        Signed distance of the plane from the entry point, along its x axis [m].
    curvature : float
        kappa [1/m].
    depth : float
        Insertion at which the needle ends [m].
    pitch : float
        Pitch at the entry in the plane's coordinates [rad].

    Raises
    ------
    UserError
        The plane is out of reach; the message gives the range of reachable planes and the insertion
        that this one needs.
    """
    lowest, highest = (float(limit) for limit in farthest_offsets(pitch, curvature, depth))
    if lowest <= offset <= highest:
        return
    needed = float(least_insertion([-offset, pitch, 0.0], curvature))
    reach = "no plane"
    if math.isfinite(lowest):
        reach = f"planes from {lowest:.4g} to {highest:.4g} m"
    raise UserError(
        f"target plane at {offset:.4g} m cannot be reached: with curvature {curvature:.4g} 1/m and "
        f"depth {depth:.4g} m the needle reaches {reach}; this one takes {needed:.4g} m"
    )


def _highest(pitch: Array, curvature: Array, length: Array) -> Array:
    limit = np.maximum(LARGEST_PITCH, pitch)
    top = np.minimum(0.5 * (curvature * length + pitch), limit)
    straight = length - (2.0 * top - pitch) / curvature
    offset = (np.cos(pitch) - 2.0 * np.cos(top) + 1.0) / curvature + straight * np.sin(limit)
    # Levelling out at once from above takes pitch / kappa at least.
    possible = curvature * length >= np.abs(pitch) - 1e-12
    return np.asarray(np.where(possible, offset, np.nan))


def _check_curvature(curvature: Array) -> None:
    bad = ~(np.isfinite(curvature) & (curvature > 0.0))
    if np.any(bad):
        value = float(np.asarray(curvature)[bad].ravel()[0])
        raise OutOfBoundsError("curvature", value, float(np.nextafter(0.0, 1.0)), math.inf, "1/m")
