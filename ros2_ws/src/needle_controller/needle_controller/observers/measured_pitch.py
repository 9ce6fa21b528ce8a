"""The shaft's measured direction as a pitch in the target plane ([KC09] section V)."""

from __future__ import annotations

import math

import numpy as np

from needle_controller.model.arrays import Array

LARGEST_PITCH_STD = math.radians(5.0)
"""A pitch known worse than this counts as not measured [rad]."""
_UNIT_TOLERANCE = 1e-3


def measured_pitch(
    direction: Array,
    direction_covariance: Array,
    R_plane_rig: Array,  # noqa: N803
) -> float:
    """Return the pitch in the target plane, NaN where it was not measured.

    A small rotation w turns a direction d by w x d; its x component, over cos(pitch), is what the
    pitch changes by.

    Parameters
    ----------
    direction : ndarray, shape (3,)
        Of the shaft at the tip, in `rig`; of unit length.
    direction_covariance : ndarray, shape (3, 3)
        Of rotations about the fixed axes of `rig` [rad^2].
    R_plane_rig : ndarray, shape (3, 3)
        `rig`'s axes in `target_plane`.

    Returns
    -------
    float
        beta = asin(d_x) of (3) [rad]; NaN where it is not of unit length, its covariance was never
        filled in, or it is known to no better than `LARGEST_PITCH_STD`.
    """
    if not np.all(np.isfinite(direction_covariance)):
        return math.nan
    if not abs(float(np.linalg.norm(direction)) - 1.0) < _UNIT_TOLERANCE:
        return math.nan
    x, y, z = (float(part) for part in R_plane_rig @ direction)
    cosine = math.hypot(y, z)
    slope = np.array([0.0, z, -y]) / max(cosine, 1e-9)
    variance = float(slope @ (R_plane_rig @ direction_covariance @ R_plane_rig.T) @ slope)
    # No direction is known exactly: a variance of 0 was never filled in.
    if not 0.0 < variance <= LARGEST_PITCH_STD**2:
        return math.nan
    return math.atan2(x, cosine)
