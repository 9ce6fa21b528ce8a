"""Obstacles that the needle must not touch: spheres and capsules in `rig`.

They come from parameters, from markers, or from a YAML file:

frame: rig
spheres:
- {center: [0.0, 0.002, 0.05], radius: 0.004}
capsules:
- {start: [-0.02, 0.0, 0.07], end: [0.02, 0.0, 0.07], radius: 0.003}
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.model.target_plane import RIG
from needle_core.compiled import compiled
from needle_core.errors import UserError
from needle_core.files.yaml_files import read_yaml
from needle_core.messages import Marker, Markers
from needle_core.rotations import rotation_from_quaternion
from needle_core.settings.bounds import check_bounds

MOST_OBSTACLES = 64
FARTHEST = 1.0
"""Largest coordinate [m]; larger values suggest another unit."""
LARGEST_RADIUS = 0.2
# Types and actions of visualization_msgs/Marker.
SPHERE, CYLINDER = 2, 3
_DELETE, _DELETEALL = 2, 3
_ROUND = 1e-3
"""Relative difference of diameters up to which a marker counts as round."""
_KINDS = {"spheres": ("center", "center"), "capsules": ("start", "end")}
_POINT = 1e-18
"""Squared length below which a segment counts as a point [m^2]."""


class Obstacle(NamedTuple):
    """A capsule: all points within a radius of a segment; a sphere if the segment is a point.

    Attributes
    ----------
    start, end : sequence of float
        Ends of the axis in `rig` [m].
    radius : float
        Radius of the capsule [m].
    """

    start: Sequence[float] | Array
    end: Sequence[float] | Array
    radius: float


class Obstacles:
    """A checked set of obstacles.

    Parameters
    ----------
    obstacles : sequence of Obstacle, or array_like, shape (N, 7)
        Obstacles in `rig`, or the `table`; error messages number them from 1.

    Attributes
    ----------
    table : ndarray, shape (N, 7)
        Ends of the axis and radius of each obstacle [m].

    Raises
    ------
    UserError
        More than `MOST_OBSTACLES`, or a number that is not finite or out of bounds.
    """

    def __init__(self, obstacles: Sequence[Obstacle] | Array = ()) -> None:
        if len(obstacles) > MOST_OBSTACLES:
            raise UserError(f"{len(obstacles)} obstacles, limit {MOST_OBSTACLES}")
        rows = [np.hstack(one) for one in obstacles]
        self.table: Array = np.array(rows, dtype=float).reshape(-1, 7)
        for number, row in enumerate(self.table.tolist(), start=1):
            for axis, value in zip("xyzxyz", row[:6], strict=True):
                check_bounds(f"{axis} of obstacle {number}", value, -FARTHEST, FARTHEST, "m")
            check_bounds(f"radius of obstacle {number}", row[6], 1e-5, LARGEST_RADIUS, "m")

    def __len__(self) -> int:
        """Return the number of obstacles."""
        return len(self.table)

    def clearance(self, position: npt.ArrayLike) -> float:
        """Return a point's distance from the nearest surface [m]: < 0 inside, inf if there is none.

        Parameters
        ----------
        position : array_like, shape (3,)
            Position in `rig` [m].
        """
        point = np.asarray(position, dtype=float)
        distances = (segment_distance(point, point, row, row[3:]) - row[6] for row in self.table)
        return float(min(distances, default=math.inf))


def obstacles_from_markers(message: Markers) -> Obstacles:
    """Return the obstacles of a message: its SPHERE and CYLINDER markers.

    A cylinder counts as the capsule around it. Deletion markers, which are for RViz, are ignored.

    Raises
    ------
    UserError
        A marker of another type or frame, one that is not round or not finite, or too many.
    """
    found = []
    for number, marker in enumerate(message.markers, start=1):
        if marker.action in {_DELETE, _DELETEALL}:
            continue
        name = f"obstacle {number} ('{marker.namespace}' {marker.number})"
        if marker.frame_id != RIG:
            raise UserError(f"{name} is given in frame '{marker.frame_id}', expected '{RIG}'")
        if marker.kind not in {SPHERE, CYLINDER}:
            raise UserError(f"{name} is of type {marker.kind}, expected SPHERE (2) or CYLINDER (3)")
        found.append(_obstacle_from_marker(name, marker))
    return Obstacles(found)


def _obstacle_from_marker(name: str, marker: Marker) -> Obstacle:
    center, sizes = np.array(marker.position), np.array(marker.scale)
    if not (np.all(np.isfinite(center)) and np.all(np.isfinite(sizes))):
        raise UserError(f"{name} is not finite: position {center} m, scale {sizes} m")
    half = np.zeros(3)
    diameters = sizes
    if marker.kind == CYLINDER:
        quaternion = np.array(marker.orientation)
        length = math.hypot(*quaternion)
        if not abs(length - 1.0) <= _ROUND:
            raise UserError(f"{name}'s quaternion has length {length:g}, expected 1")
        half = 0.5 * sizes[2] * rotation_from_quaternion(quaternion / length)[:, 2]
        diameters = sizes[:2]
    if np.ptp(diameters) > _ROUND * float(np.max(np.abs(diameters))):
        raise UserError(f"{name} is not round: scale {sizes} m")
    return Obstacle(center - half, center + half, 0.5 * float(np.max(diameters)))


def read_obstacles(path: Path) -> Obstacles:
    """Return the obstacles of a YAML file, whose lengths are in metres.

    Raises
    ------
    UserError
        A file that cannot be read or has another structure or frame, or an obstacle that is
        incomplete, not finite or out of bounds.
    """
    document = read_yaml(path)
    if not isinstance(document, dict):
        raise UserError(f"{path}: expected frame, spheres and capsules")
    unknown = sorted(str(key) for key in document if key not in {"frame", *_KINDS})
    if unknown:
        raise UserError(f"{path}: {unknown[0]} is not one of frame, {', '.join(_KINDS)}")
    if document.get("frame") != RIG:
        raise UserError(f"{path}: frame {document.get('frame')!r}, expected '{RIG}'")
    obstacles = []
    for kind, (first, last) in _KINDS.items():
        rows = document.get(kind) or []
        if not isinstance(rows, list):
            raise UserError(f"{path}: {kind} is not a list")
        for number, row in enumerate(rows, start=1):
            name = f"{path}: {kind}, number {number}"
            if not isinstance(row, dict) or set(row) != {first, last, "radius"}:
                fields = ", ".join(dict.fromkeys((first, last, "radius")))
                raise UserError(f"{name}: expected {fields}")
            start, end = (_point(f"{name}: {key}", row[key]) for key in (first, last))
            obstacles.append(Obstacle(start, end, _number(f"{name}: radius", row["radius"])))
    try:
        return Obstacles(obstacles)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def _point(name: str, value: Any) -> list[float]:
    if not isinstance(value, list) or len(value) != 3:
        raise UserError(f"{name} = {value!r}, expected three numbers")
    return [_number(name, number) for number in value]


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise UserError(f"{name} = {value!r}, expected a number")
    return float(value)


@compiled
def segment_distance(first: Array, second: Array, third: Array, fourth: Array) -> float:
    """Return the least distance between the segments first-second and third-fourth [m].

    Parameters
    ----------
    first, second, third, fourth : ndarray, shape (>= 3,)
        Ends of the segments, of which only the first three numbers are used [m].
    """
    d1x, d1y, d1z = second[0] - first[0], second[1] - first[1], second[2] - first[2]
    d2x, d2y, d2z = fourth[0] - third[0], fourth[1] - third[1], fourth[2] - third[2]
    rx, ry, rz = first[0] - third[0], first[1] - third[1], first[2] - third[2]
    a = d1x * d1x + d1y * d1y + d1z * d1z
    e = d2x * d2x + d2y * d2y + d2z * d2z
    b = d1x * d2x + d1y * d2y + d1z * d2z
    c = d1x * rx + d1y * ry + d1z * rz
    f = d2x * rx + d2y * ry + d2z * rz
    # The nearest points of the lines, clipped to one segment after the other.
    s = 0.0
    if a > _POINT:
        determinant = a * e - b * b
        if determinant > 1e-12 * a * e:
            s = min(max((b * f - c * e) / determinant, 0.0), 1.0)
        elif e <= _POINT:
            s = min(max(-c / a, 0.0), 1.0)
    t = 0.0
    if e > _POINT:
        t = (b * s + f) / e
        clipped = min(max(t, 0.0), 1.0)
        if clipped != t or a <= _POINT:
            t = clipped
            if a > _POINT:
                s = min(max((b * t - c) / a, 0.0), 1.0)
    x, y, z = rx + d1x * s - d2x * t, ry + d1y * s - d2y * t, rz + d1z * s - d2z * t
    return math.sqrt(x * x + y * y + z * z)
