"""Obstacles from markers."""

from __future__ import annotations

import math

import numpy as np

from needle_controller.model.kinematics import rotation_from_quaternion
from needle_controller.model.target_plane import RIG
from needle_controller.planning.obstacles import Obstacle, Obstacles
from needle_core.errors import UserError
from needle_core.messages import Marker, Markers

# Of visualization_msgs/Marker.
SPHERE, CYLINDER = 2, 3
_DELETE, _DELETEALL = 2, 3
_ROUND = 1e-3
"""Share by which the diameters of something round may differ."""


def obstacles_from_markers(message: Markers) -> Obstacles:
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
        if marker.action in {_DELETE, _DELETEALL}:
            continue
        name = f"obstacle {number} ('{marker.namespace}' {marker.number})"
        if marker.frame_id != RIG:
            raise UserError(f"{name} is given in frame '{marker.frame_id}', wants '{RIG}'")
        if marker.kind not in {SPHERE, CYLINDER}:
            raise UserError(f"{name} is of type {marker.kind}, wants SPHERE (2) or CYLINDER (3)")
        found.append(_obstacle(name, marker))
    return Obstacles(found)


def _obstacle(name: str, marker: Marker) -> Obstacle:
    center, sizes = np.array(marker.position), np.array(marker.scale)
    if not (np.all(np.isfinite(center)) and np.all(np.isfinite(sizes))):
        raise UserError(f"{name} is not finite: position {center} m, scale {sizes} m")
    half = np.zeros(3)
    across = sizes
    if marker.kind == CYLINDER:
        quaternion = np.array(marker.orientation)
        length = math.hypot(*quaternion)
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
