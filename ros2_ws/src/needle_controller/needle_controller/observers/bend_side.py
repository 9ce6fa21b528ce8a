"""To which side the needle bends within the plane: the sign of cos(roll), which s cannot say.

s = (x, sin(pitch), kappa cos(pitch) sin(roll)) of [KC09] (6) is the same for a roll and for pi
minus it. With the sign of cos(roll) beside it, `bend_sign`, the paper's coordinates hold on both
sides: near roll 0 (+1) and near roll pi (-1). A flip of the bevel (Reed et al. 2008) changes the
sign. It is made mirrored, a turn from roll to pi - roll: s3, the curvature out of the plane, stays
as it is while the needle bends to the other side within it. After a turn by pi instead, s3 would be
-s3; and so the error of s3 changes its sign in either case.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import reduced_from_linearized


def bend_sign_of(roll: npt.ArrayLike) -> Array:
    """Return the sign of cos(roll): +1 or -1, shape (...).

    Parameters
    ----------
    roll : array_like, shape (...)
        Roll in `target_plane` [rad].
    """
    return np.asarray(np.where(np.cos(np.asarray(roll, dtype=float)) < 0.0, -1.0, 1.0))


def wrapped(angle: npt.ArrayLike) -> Array:
    """Return angles in [-pi, pi), shape (...) [rad]."""
    return np.asarray((np.asarray(angle, dtype=float) + np.pi) % (2.0 * np.pi) - np.pi)


def reduced_on_side(
    linearized: npt.ArrayLike, curvature: npt.ArrayLike, bend_sign: npt.ArrayLike
) -> Array:
    """Return r of s on the side that `bend_sign` names: the inverse of (6).

    Parameters
    ----------
    linearized : array_like, shape (..., 3)
        s within s2^2 + (s3 / kappa)^2 < 1 (see `saturation`).
    curvature : array_like, shape (...)
        Curvature of the needle's path, kappa [1/m].
    bend_sign : array_like, shape (...)
        Sign of cos(roll), +1 or -1.

    Returns
    -------
    ndarray, shape (..., 3)
        x [m], pitch, roll [rad], roll in [-pi, pi); NaN where s lies outside the region.
    """
    sign = np.asarray(bend_sign, dtype=float)
    shape = np.broadcast_shapes(np.shape(linearized)[:-1], sign.shape)
    reduced: Array = np.empty((*shape, 3))
    reduced[...] = reduced_from_linearized(linearized, curvature)
    roll = reduced[..., 2]
    reduced[..., 2] = np.where(sign < 0.0, wrapped(np.pi - roll), roll)
    return reduced


def mirrored_turn(roll: npt.ArrayLike, bend_sign: npt.ArrayLike) -> Array:
    """Return the shortest turn that takes a roll to a side with its sine unchanged.

    Parameters
    ----------
    roll : array_like, shape (...)
        Roll in `target_plane` [rad].
    bend_sign : array_like, shape (...)
        Wanted sign of cos(roll), +1 or -1; 0 takes the present one.

    Returns
    -------
    ndarray, shape (...)
        pi - 2 roll, to within a full turn, in [-pi, pi) [rad]; 0 where the roll is there already.
    """
    roll, sign = np.asarray(roll, dtype=float), np.asarray(bend_sign, dtype=float)
    there = sign * bend_sign_of(roll) >= 0.0
    return np.asarray(np.where(there, 0.0, wrapped(np.pi - 2.0 * roll)))
