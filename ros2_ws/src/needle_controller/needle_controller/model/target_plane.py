"""The target plane: the y-z plane of a frame in `rig`."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_core.errors import UserError
from needle_core.rotations import rotation_from_quaternion

UNIT_TOLERANCE = 1e-3
RIG = "rig"


@dataclasses.dataclass(frozen=True)
class TargetPlane:
    """Pose of the frame `target_plane` in `rig`.

    Attributes
    ----------
    T_rig_plane : ndarray, shape (4, 4)
        A rigid transform [m].
    """

    T_rig_plane: Array

    @property
    def T_plane_rig(self) -> Array:  # noqa: N802
        """The inverse: `rig` in `target_plane`, shape (4, 4)."""
        inverse = np.eye(4)
        inverse[:3, :3] = self.T_rig_plane[:3, :3].T
        inverse[:3, 3] = -self.T_rig_plane[:3, :3].T @ self.T_rig_plane[:3, 3]
        return inverse

    @property
    def offset(self) -> float:
        """Signed distance of the plane from the entry point, along its own x axis [m]."""
        return float(self.T_rig_plane[:3, 0] @ self.T_rig_plane[:3, 3])

    def from_rig(self, position: npt.ArrayLike) -> Array:
        """Transform positions in `rig` to `target_plane`, shape (..., 3) [m]."""
        shifted = np.asarray(position, dtype=float) - self.T_rig_plane[:3, 3]
        return np.asarray(shifted @ self.T_rig_plane[:3, :3])


def offset_plane(offset: float) -> TargetPlane:
    """Return the default plane, x = offset [m] of `rig`."""
    transform = np.eye(4)
    transform[0, 3] = offset
    return TargetPlane(transform)


def plane_from_pose(
    frame_id: str, position: npt.ArrayLike, quaternion: npt.ArrayLike
) -> TargetPlane:
    """Return the plane of a received pose.

    Parameters
    ----------
    frame_id : str
        Frame of the pose; must be `rig`.
    position : array_like, shape (3,)
        Origin of `target_plane` [m].
    quaternion : array_like, shape (4,)
        Its orientation, x y z w, of unit length.

    Returns
    -------
    TargetPlane
        The checked plane.

    Raises
    ------
    UserError
        Another frame, a number that is not finite, a quaternion that is not a unit vector, or a
        plane that is almost perpendicular to the entering needle.
    """
    if frame_id != RIG:
        raise UserError(f"target_plane is given in frame '{frame_id}', expected '{RIG}'")
    origin, q = np.asarray(position, dtype=float), np.asarray(quaternion, dtype=float)
    if not (np.all(np.isfinite(origin)) and np.all(np.isfinite(q))):
        raise UserError(f"target_plane is not finite: position {origin}, orientation {q}")
    norm = math.hypot(*q)
    if abs(norm - 1.0) > UNIT_TOLERANCE:
        raise UserError(f"target_plane's quaternion has length {norm:g}, expected 1")
    transform = np.eye(4)
    transform[:3, :3] = rotation_from_quaternion(q / norm)
    transform[:3, 3] = origin
    plane = TargetPlane(transform)
    # Sine of the entering needle's pitch in the plane's coordinates.
    if abs(transform[2, 0]) > np.sin(np.deg2rad(80.0)):
        angle = np.rad2deg(np.arcsin(min(1.0, abs(transform[2, 0]))))
        raise UserError(f"the needle enters at {angle:.0f} deg to target_plane, limit 80 deg")
    return plane


def point_from_message(name: str, frame_id: str, position: npt.ArrayLike) -> Array:
    """Return a received point, shape (3,), of `rig` [m]; `name` is for errors.

    Raises
    ------
    UserError
        Another frame, or numbers that are not finite.
    """
    point = np.asarray(position, dtype=float)
    if frame_id != RIG:
        raise UserError(f"{name} is given in frame '{frame_id}', expected '{RIG}'")
    if not np.all(np.isfinite(point)):
        raise UserError(f"{name} is not finite: {point}")
    return point
