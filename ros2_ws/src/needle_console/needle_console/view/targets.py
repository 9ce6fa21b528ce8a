"""Checks of targets typed in mm and degrees, and their conversion to `rig`."""

from __future__ import annotations

import math

import numpy as np

from needle_console.view.snapshot import Array
from needle_core.settings.bounds import check_bounds

LARGEST_OFFSET_MM, LARGEST_TILT_DEG, LARGEST_MM = 50.0, 45.0, 150.0


def plane_pose(offset_mm: float, tilt_deg: float) -> Array:
    """Return the frame of a plane above the entry that rises along the insertion.

    Parameters
    ----------
    offset_mm : float
        Height of the plane above the entry, along its normal.
    tilt_deg : float
        Angle by which the plane rises along the insertion.

    Returns
    -------
    ndarray, shape (4, 4)
        T_rig_plane [m].

    Raises
    ------
    UserError
        If a number is not finite or out of bounds.
    """
    check_bounds("offset", offset_mm, -LARGEST_OFFSET_MM, LARGEST_OFFSET_MM, "mm")
    check_bounds("tilt", tilt_deg, -LARGEST_TILT_DEG, LARGEST_TILT_DEG, "deg")
    tilt = math.radians(tilt_deg)
    pose = np.eye(4)
    pose[:3, 0] = math.cos(tilt), 0.0, -math.sin(tilt)
    pose[:3, 2] = math.sin(tilt), 0.0, math.cos(tilt)
    pose[:3, 3] = pose[:3, 0] * offset_mm * 1e-3
    return pose


def target_point(x_mm: float, y_mm: float, z_mm: float) -> Array:
    """Return a target point in `rig`, shape (3,) [m].

    Raises
    ------
    UserError
        If a number is not finite or out of bounds.
    """
    for name, value in (("x", x_mm), ("y", y_mm)):
        check_bounds(name, value, -LARGEST_MM, LARGEST_MM, "mm")
    check_bounds("z", z_mm, 1.0, LARGEST_MM, "mm")
    return np.array([x_mm, y_mm, z_mm]) * 1e-3
