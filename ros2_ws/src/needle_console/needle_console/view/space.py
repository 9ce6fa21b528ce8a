"""Positions and shapes in the 3D view: in mm, z up, x along the insertion."""

from __future__ import annotations

import math

import numpy as np

from needle_console.view.snapshot import Array, Snapshot

# Rotation from `rig` (x up, z inwards) to the view.
R_VIEW_RIG = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
SIGMAS = 2.0
_MM = 1e3
# Length of a straight piece of the drawn shaft [m].
_PIECE = 2e-3


def to_view(points: Array) -> Array:
    """Transform points from `rig` [m] to the view [mm], shape (..., 3)."""
    return np.asarray(points @ R_VIEW_RIG.T * _MM)


def shaft_points(snapshot: Snapshot) -> Array:
    """Return points of the shaft in the view, shape (n, 3) [mm]: every 2 mm, and the tip."""
    shaft = snapshot.shaft
    chosen = [0]
    for index, point in enumerate(shaft):
        if math.dist(point, shaft[chosen[-1]]) >= _PIECE:
            chosen.append(index)
    if chosen[-1] != len(shaft) - 1:
        chosen.append(len(shaft) - 1)
    return to_view(shaft[chosen])


def ellipsoid(snapshot: Snapshot) -> tuple[Array, Array, Array] | None:
    """Return the 2-sigma ellipsoid of the tip: centre, half axes [mm], rotation.

    Returns
    -------
    tuple of ndarray, or None
        Shapes (3,), (3,) and (3, 3), in the view; the half axes are the rotation's columns. None
        without an estimate or a measured tip.
    """
    if snapshot.track:
        position, covariance = snapshot.track[-1].position, snapshot.track[-1].covariance
    elif snapshot.tip is not None:
        position, covariance = snapshot.tip.position, snapshot.tip.covariance
    else:
        return None
    values, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    if np.linalg.det(axes) < 0.0:
        axes[:, 0] = -axes[:, 0]
    half = SIGMAS * np.sqrt(np.maximum(values, 0.0)) * _MM
    return to_view(position), half, R_VIEW_RIG @ axes


def plane_rotation(snapshot: Snapshot) -> Array:
    """Return the rotation of a flat box (thin along z) into the target plane, (3, 3)."""
    R = snapshot.T_rig_plane[:3, :3]  # noqa: N806
    # The box's x axis is the plane's z axis, and its z axis is the plane's normal.
    return np.asarray(R_VIEW_RIG @ R @ R_VIEW_RIG.T)


def plane_centre(snapshot: Snapshot, length: float) -> Array:
    """Return the centre of the plane's first `length` [m] along its z, in the view, (3,) [mm]."""
    return to_view(snapshot.T_rig_plane[:3, 3] + snapshot.T_rig_plane[:3, 2] * 0.5 * length)
