"""Whether the needle can still reach the wanted plane, and the smallest depth at which it can.

On the reduced model (5) of [KC09], with the roll free to choose, the pitch changes by at most kappa
per inserted length, and x by sin(pitch): a double integrator with |x''| <= kappa to first order.
The soonest way into the plane and along it is roll +90 deg, then -90 deg (or the other way round),
with a straight stretch at the largest pitch in between if that is met. Along arcs of roll +-90 deg
everything is closed form: over a length l the pitch changes by kappa l, and from pitch b0 to b1 x
changes by +-(cos b0 - cos b1) / kappa. That is exact but for the turning of the roll itself, which
is taken to need no insertion: the depths here are the least that any law can need.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_core.errors import OutOfBoundsError, UserError

LARGEST_PITCH = math.radians(80.0)
"""Beyond this the coordinates (3) fail, and no needle should go there."""


@dataclasses.dataclass(frozen=True)
class Reachability:
    """Whether the plane can still be reached.

    Attributes
    ----------
    reachable : ndarray of bool, shape (...)
        Whether the needle can lie in the plane at the insertion at which it ends.
    depth : ndarray, shape (...)
        Smallest insertion at which it can [m].
    """

    reachable: npt.NDArray[np.bool_]
    depth: Array


def reachability(
    reduced: npt.ArrayLike,
    curvature: npt.ArrayLike,
    *,
    insertion: npt.ArrayLike,
    end: npt.ArrayLike,
    pitch_limit: float = LARGEST_PITCH,
    tolerance: float = 0.0,
) -> Reachability:
    """Return whether the plane can still be reached in the insertion that is left.

    Parameters
    ----------
    reduced : array_like, shape (..., 3)
        x [m], pitch, roll [rad]; the roll does not matter.
    curvature : array_like, shape (...)
        kappa [1/m].
    insertion, end : array_like, shape (...)
        Present insertion, and the one at which steering ends [m].
    pitch_limit : float
        Largest pitch on the way, in (0, 90 deg) [rad].
    tolerance : float
        Distance from the plane that counts as in it [m].

    Returns
    -------
    Reachability
        The answer, and the smallest insertion at which it is yes.

    Raises
    ------
    OutOfBoundsError
        A curvature, pitch, limit or tolerance out of bounds.
    """
    insertion = np.asarray(insertion, dtype=float)
    depth = insertion + least_insertion(
        reduced, curvature, pitch_limit=pitch_limit, tolerance=tolerance
    )
    return Reachability(np.asarray(depth <= np.asarray(end, dtype=float)), depth)


def least_insertion(
    reduced: npt.ArrayLike,
    curvature: npt.ArrayLike,
    *,
    pitch_limit: float = LARGEST_PITCH,
    tolerance: float = 0.0,
) -> Array:
    """Return the least insertion after which the needle can lie in the plane, pitch 0.

    Parameters
    ----------
    reduced : array_like, shape (..., 3)
        x [m], pitch, roll [rad]; the roll does not matter.
    curvature : array_like, shape (...)
        kappa [1/m].
    pitch_limit : float
        Largest pitch on the way, in (0, 90 deg); a needle that is steeper already gets no steeper.
    tolerance : float
        Distance from the plane that counts as in it [m].

    Returns
    -------
    ndarray, shape (...)
        [m]; NaN where the state is.

    Raises
    ------
    OutOfBoundsError
        A curvature, pitch, limit or tolerance out of bounds.
    """
    reduced, curvature = np.asarray(reduced, dtype=float), np.asarray(curvature, dtype=float)
    _check(curvature, pitch_limit)
    if not 0.0 <= tolerance < math.inf:
        raise OutOfBoundsError("tolerance", tolerance, 0.0, math.inf, "m")
    x, pitch = reduced[..., 0], reduced[..., 1]
    steepest = np.abs(pitch[np.isfinite(pitch)])
    if np.any(steepest >= 0.5 * np.pi):
        worst = float(np.max(steepest))
        raise OutOfBoundsError("|pitch|", worst, 0.0, 0.5 * math.pi, "rad")
    # Where it would lie if it levelled out at once.
    level_x = x + np.sign(pitch) * (1.0 - np.cos(pitch)) / curvature
    # The nearest place in the plane's band; below it the needle goes up first (+x).
    way = level_x - np.clip(level_x, -tolerance, tolerance)
    up = np.where(way > 0.0, -1.0, 1.0)
    distance, start = up * (x - (level_x - way)), up * pitch
    # Up to the pitch `top`, then level out: x gains (cos start - 2 cos top + 1) / kappa.
    cosine = 0.5 * (1.0 + np.cos(start) + curvature * distance)
    limit = np.maximum(pitch_limit, start)
    top = np.minimum(np.arccos(np.clip(cosine, -1.0, 1.0)), limit)
    top = np.maximum(top, start)
    short = 2.0 * (np.cos(top) - cosine) / curvature
    straight = np.maximum(short, 0.0) / np.sin(limit)
    length = (2.0 * top - start) / curvature + straight
    level = np.abs(pitch) / curvature
    return np.asarray(np.where(np.abs(way) <= 0.0, level, length))


def farthest_offsets(
    pitch: npt.ArrayLike,
    curvature: npt.ArrayLike,
    length: npt.ArrayLike,
    *,
    pitch_limit: float = LARGEST_PITCH,
) -> tuple[Array, Array]:
    """Return how far below and above the tip the planes are that an insertion can reach.

    Parameters
    ----------
    pitch : array_like, shape (...)
        Pitch of the needle in the planes' coordinates [rad].
    curvature : array_like, shape (...)
        kappa [1/m].
    length : array_like, shape (...)
        Insertion that is left, >= 0 [m].
    pitch_limit : float
        Largest pitch on the way, in (0, 90 deg) [rad].

    Returns
    -------
    lowest, highest : ndarray, shape (...)
        Offsets of planes from the tip along their x axis [m]; NaN where the length does not even
        do to level out.

    Raises
    ------
    OutOfBoundsError
        A curvature or limit out of bounds.
    """
    pitch, curvature = np.asarray(pitch, dtype=float), np.asarray(curvature, dtype=float)
    length = np.asarray(length, dtype=float)
    _check(curvature, pitch_limit)
    highest = _highest(pitch, curvature, length, pitch_limit)
    return -_highest(-pitch, curvature, length, pitch_limit), highest


def check_offset(offset: float, curvature: float, depth: float, pitch: float = 0.0) -> None:
    """Check that a plane can be reached by a needle that is still out.

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
        The plane is farther than the needle can ever go: says how far it can, and from what depth
        on it could.
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


def _highest(pitch: Array, curvature: Array, length: Array, pitch_limit: float) -> Array:
    limit = np.maximum(pitch_limit, pitch)
    top = np.minimum(0.5 * (curvature * length + pitch), limit)
    straight = length - (2.0 * top - pitch) / curvature
    offset = (np.cos(pitch) - 2.0 * np.cos(top) + 1.0) / curvature + straight * np.sin(limit)
    # Levelling out at once from above takes pitch / kappa at least.
    possible = curvature * length >= np.abs(pitch) - 1e-12
    return np.asarray(np.where(possible, offset, np.nan))


def _check(curvature: Array, pitch_limit: float) -> None:
    bad = ~(np.isfinite(curvature) & (curvature > 0.0))
    if np.any(bad):
        value = float(np.asarray(curvature)[bad].ravel()[0])
        raise OutOfBoundsError("curvature", value, float(np.nextafter(0.0, 1.0)), math.inf, "1/m")
    if not 0.0 < pitch_limit < 0.5 * math.pi:
        raise OutOfBoundsError("pitch_limit", pitch_limit, 0.0, 0.5 * math.pi, "rad")
