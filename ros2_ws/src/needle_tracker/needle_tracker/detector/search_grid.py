"""Polar grid, about the entry, of the places where the needle can be in the image of a camera.

The grid lies in the plane through z of `rig` that faces the window of the camera.

The needle passes the entry point, and along an arc the chord turns only half as fast as the needle:
in polar coordinates about the entry, a reachable needle runs outwards, row by row. The search
excludes everything outside the grid (sheath, hole, rim of the phantom).
"""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
from numpy.typing import NDArray

from needle_tracker.optics.refraction import RefractedCamera

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclasses.dataclass(frozen=True)
class Reach:
    """Physical reach of the needle.

    Attributes
    ----------
    curvature : float
        Largest curvature of its path [1/m].
    entry_angle : float
        Largest angle of its heading to z at the entry [rad].
    hole_tolerance : float
        Largest offset of its path at the entry [m].
    length : float
        Longest insertion [m].
    """

    curvature: float
    entry_angle: float
    hole_tolerance: float
    length: float

    def shortest_chord(self, insertion: float) -> float:
        """Return the least distance of tip and entry [m] after `insertion` [m] along one arc."""
        half_turn = min(0.5 * self.curvature * insertion, math.pi / 2)
        return 2.0 * math.sin(half_turn) / self.curvature if self.curvature > 0.0 else insertion

    def chord_angle(self, distance: Array) -> Array:
        """Return the largest angle to z [rad] of a point of the needle at `distance` [m]."""
        turned = np.arcsin(np.clip(0.5 * self.curvature * distance, 0.0, 1.0))
        hole = np.arctan2(self.hole_tolerance, distance)
        return np.asarray(self.entry_angle + turned + hole)


@dataclasses.dataclass(frozen=True)
class SearchGrid:
    """The polar grid of one camera.

    Attributes
    ----------
    distances : ndarray, shape (rows,)
        Distance of each row from the entry [m].
    angles : ndarray, shape (columns,)
        Angle of each column to z, positive towards `RefractedCamera.sideways` [rad].
    pixels : ndarray, shape (rows, columns, 2), float32
        Pixels of the points of the grid.
    reachable : ndarray, shape (rows, columns)
        True where the needle can be and the camera sees the point.
    """

    distances: Array
    angles: Array
    pixels: NDArray[np.float32]
    reachable: Mask

    @property
    def row_pitch(self) -> float:
        """Distance between rows [m]."""
        return float(self.distances[1] - self.distances[0])

    @property
    def angle_pitch(self) -> float:
        """Angle between columns [rad]."""
        return float(self.angles[1] - self.angles[0])

    def row_of(self, distance: float) -> int:
        """Return the index of the row nearest to a distance from the entry [m]."""
        row = round((distance - float(self.distances[0])) / self.row_pitch)
        return min(max(row, 0), len(self.distances) - 1)


@dataclasses.dataclass(frozen=True)
class GridSettings:
    """Numbers of the search grid.

    Attributes
    ----------
    row_pitch : float
        Distance between rows [m]: about the width of a thin needle.
    angle_pitch : float
        Angle between columns [rad]: 0.5 mm at the longest insertion.
    parallax_angle : float
        Angle by which a needle before or behind the plane appears displaced [rad].
    body_offset : float
        Largest distance of the shaft from the path of its tip [m], for a pre-bend of 10 deg over
        9 mm.
    border_px : int
        Width of the border of the image that is not searched [px].
    """

    row_pitch: float = 0.5e-3
    angle_pitch: float = math.radians(0.25)
    parallax_angle: float = math.radians(6.0)
    body_offset: float = 1.0e-3
    border_px: int = 6


# The trackers of one rig share the grids of its two cameras.
@functools.lru_cache(maxsize=2)
def make_search_grid(view: RefractedCamera, reach: Reach, first_distance: float) -> SearchGrid:
    """Return the grid of one camera.

    Parameters
    ----------
    view : RefractedCamera
        The camera.
    reach : Reach
        Physical reach of the needle.
    first_distance : float
        Distance of the first row from the entry, outside the entry hole [m].
    """
    settings, camera = GridSettings(), view.camera
    distances = np.arange(first_distance, reach.length, settings.row_pitch)
    limit = reach.chord_angle(distances) + settings.parallax_angle
    limit += np.arctan2(settings.body_offset, distances)
    # Close to the entry the hole tolerance would allow any angle.
    widest = min(float(limit[len(limit) // 2 :].max()), math.pi / 2)
    half = math.ceil(widest / settings.angle_pitch)
    angles = np.asarray(settings.angle_pitch * np.arange(-half, half + 1), dtype=np.float64)
    directions = np.sin(angles)[:, None] * view.sideways + np.cos(angles)[:, None] * [0.0, 0.0, 1.0]
    pixels = view.project(distances[:, None, None] * directions)
    last = np.array([camera.width, camera.height]) - 1 - settings.border_px
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= settings.border_px) & (pixels <= last)).all(axis=-1)
    reachable = inside & (np.abs(angles) <= limit[:, None])
    # A point behind the camera is put outside the image.
    pixels32 = np.nan_to_num(pixels, nan=-1.0).astype(np.float32)
    return SearchGrid(distances, angles, pixels32, reachable)
