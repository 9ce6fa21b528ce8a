"""The needle's generalized coordinates ([KC09] (3)) and its orientation.

Paper symbols: q = (x, y, z, alpha, beta, gamma) are the coordinates (tip position, yaw, pitch,
roll), r = (x, beta, gamma) the reduced state. All are in the frame `target_plane`, whose y-z plane
is the desired plane. Leading axes broadcast.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array

X, Y, Z, YAW, PITCH, ROLL = range(6)
"""Indices into the coordinates q."""
REDUCED = (X, PITCH, ROLL)
"""Indices of the reduced state r within the coordinates q."""


def rotation_from_angles(angles: npt.ArrayLike) -> Array:
    """Return R = Rx(yaw) Ry(pitch) Rz(roll), the tip's orientation.

    Parameters
    ----------
    angles : array_like, shape (..., 3)
        Yaw alpha, pitch beta, roll gamma [rad].

    Returns
    -------
    ndarray, shape (..., 3, 3)
        Columns are the tip's axes in `target_plane`; the third is the heading.
    """
    angles = np.asarray(angles, dtype=float)
    ca, cb, cg = np.moveaxis(np.cos(angles), -1, 0)
    sa, sb, sg = np.moveaxis(np.sin(angles), -1, 0)
    rows = [
        [cb * cg, -cb * sg, sb],
        [ca * sg + sa * sb * cg, ca * cg - sa * sb * sg, -sa * cb],
        [sa * sg - ca * sb * cg, sa * cg + ca * sb * sg, ca * cb],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def angles_from_rotation(rotation: npt.ArrayLike) -> Array:
    """Return yaw, pitch, roll of an orientation: the inverse of `rotation_from_angles`.

    Parameters
    ----------
    rotation : array_like, shape (..., 3, 3)
        Rotation matrices, tip in `target_plane`.

    Returns
    -------
    ndarray, shape (..., 3)
        Yaw and roll in (-pi, pi], pitch in [-pi/2, pi/2] [rad]. At pitch +-pi/2 only the sum or
        difference of yaw and roll is defined (the singularity of (3)); rounding determines both.
    """
    rotation = np.asarray(rotation, dtype=float)
    yaw = np.arctan2(-rotation[..., 1, 2], rotation[..., 2, 2])
    pitch = np.arcsin(np.clip(rotation[..., 0, 2], -1.0, 1.0))
    roll = np.arctan2(-rotation[..., 0, 1], rotation[..., 0, 0])
    return np.stack([yaw, pitch, roll], axis=-1)


def angle_axes(angles: npt.ArrayLike) -> Array:
    """Return the axes in `target_plane` about which yaw, pitch and roll turn the tip.

    A small change of the angles turns the tip by the rotation vector `angle_axes(angles) @ change`;
    this carries a covariance of the angles into the fixed-axis convention of
    geometry_msgs/PoseWithCovariance.

    Parameters
    ----------
    angles : array_like, shape (..., 3)
        Yaw, pitch, roll [rad].

    Returns
    -------
    ndarray, shape (..., 3, 3)
        Columns are the unit axes of yaw, pitch and roll.
    """
    angles = np.asarray(angles, dtype=float)
    yaw = angles[..., 0]
    one, zero = np.ones_like(yaw), np.zeros_like(yaw)
    about_yaw = np.stack([one, zero, zero], axis=-1)
    about_pitch = np.stack([zero, np.cos(yaw), np.sin(yaw)], axis=-1)
    heading = rotation_from_angles(angles)[..., 2]
    return np.stack([about_yaw, about_pitch, heading], axis=-1)
