"""Obstacles from markers."""

from __future__ import annotations

import numpy as np
from visualization_msgs.msg import Marker, MarkerArray

from needle_common.errors import UserError
from needle_controller.model.kinematics import rotation_from_quaternion
from needle_controller.model.target_plane import RIG
from needle_controller.planning.obstacles import Obstacle, Obstacles

OBSTACLES = "obstacles"
_ROUND = 1e-3
"""Share by which the diameters of something round may differ."""


def to_obstacles(message: MarkerArray) -> Obstacles:
    """Return the obstacles of a message: its SPHERE and CYLINDER markers, which replace all before.

    A cylinder is taken as the capsule around it. Markers that delete are what RViz needs, and add
    nothing here.

    Raises
    ------
    UserError
        A marker of another type or frame, that is not round or not finite, or too many of them.
    """
    found = []
    for number, marker in enumerate(message.markers, start=1):
        if marker.action in {Marker.DELETE, Marker.DELETEALL}:
            continue
        name = f"obstacle {number} ('{marker.ns}' {marker.id})"
        if marker.header.frame_id != RIG:
            raise UserError(f"{name} is given in frame '{marker.header.frame_id}', wants '{RIG}'")
        if marker.type not in {Marker.SPHERE, Marker.CYLINDER}:
            raise UserError(f"{name} is of type {marker.type}, wants SPHERE (2) or CYLINDER (3)")
        found.append(_obstacle(name, marker))
    return Obstacles(found)


def _obstacle(name: str, marker: Marker) -> Obstacle:
    p, q, scale = marker.pose.position, marker.pose.orientation, marker.scale
    center, sizes = np.array([p.x, p.y, p.z]), np.array([scale.x, scale.y, scale.z])
    if not (np.all(np.isfinite(center)) and np.all(np.isfinite(sizes))):
        raise UserError(f"{name} is not finite: position {center} m, scale {sizes} m")
    half = np.zeros(3)
    across = sizes
    if marker.type == Marker.CYLINDER:
        quaternion = np.array([q.x, q.y, q.z, q.w])
        length = float(np.linalg.norm(quaternion))
        if not abs(length - 1.0) <= _ROUND:
            raise UserError(f"{name}'s quaternion has length {length:g}, wants 1")
        half = 0.5 * sizes[2] * rotation_from_quaternion(quaternion / length)[:, 2]
        across = sizes[:2]
    if np.ptp(across) > _ROUND * float(np.max(np.abs(across))):
        raise UserError(f"{name} is not round: scale {sizes} m")
    start, end = center - half, center + half
    return Obstacle(
        (float(start[0]), float(start[1]), float(start[2])),
        (float(end[0]), float(end[1]), float(end[2])),
        0.5 * float(np.max(across)),
    )
