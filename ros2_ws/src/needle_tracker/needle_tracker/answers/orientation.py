"""A shaft direction as the orientation of a pose message, and its covariance."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# What is not measured at all is uncertain by half a turn either way; finite, because an infinite
# covariance says that there is no tip.
ROLL_VARIANCE = math.pi**2


def orientation(direction: Array) -> Array:
    """Return the quaternion of the frame whose z axis is the shaft, with roll gamma = 0.

    R = Rx(alpha) Ry(beta) with pitch beta = asin(d_x) and yaw alpha = atan2(-d_y, d_z): the roll,
    which cannot be seen, is zero in the coordinates of [KC09].

    Parameters
    ----------
    direction : ndarray, shape (3,)
        Unit vector in `rig`.

    Returns
    -------
    ndarray, shape (4,)
        Unit quaternion x, y, z, w.
    """
    d_x, d_y, d_z = (float(part) for part in direction)
    half_pitch = 0.5 * math.asin(min(max(d_x, -1.0), 1.0))
    half_yaw = 0.5 * math.atan2(-d_y, d_z)
    sin_a, cos_a = math.sin(half_yaw), math.cos(half_yaw)
    sin_b, cos_b = math.sin(half_pitch), math.cos(half_pitch)
    return np.array([sin_a * cos_b, cos_a * sin_b, sin_a * sin_b, cos_a * cos_b])


def rotation_covariance(direction: Array, direction_covariance: Array) -> Array:
    """Return the covariance of rotations about the fixed x, y, z axes, roll unknown.

    A small rotation w turns d by w x d; the part of w across d is d x (w x d), the part along d is
    the roll.

    Parameters
    ----------
    direction : ndarray, shape (3,)
        Unit vector in `rig`.
    direction_covariance : ndarray, shape (3, 3)
        Of the direction [-].

    Returns
    -------
    ndarray, shape (3, 3)
        [rad^2], with `ROLL_VARIANCE` about the shaft.
    """
    cross = np.cross(direction, np.eye(3), axisb=0, axisc=0)
    across = cross @ direction_covariance @ cross.T
    return np.asarray(across + ROLL_VARIANCE * np.outer(direction, direction))
