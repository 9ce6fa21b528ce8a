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
from needle_tracker.tracker_parameters import StereoTrackerParameters

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


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
def make_search_grid(view: RefractedCamera, needle: StereoTrackerParameters) -> SearchGrid:
    """Return the grid of one camera, from outside the entry hole on.

    Parameters
    ----------
    view : RefractedCamera
        The camera.
    needle : StereoTrackerParameters
        Reach of the needle, and the entry hole.
    """
    settings, camera = GridSettings(), view.camera
    distances = np.arange(needle.hole_clearance, needle.max_insertion, settings.row_pitch)
    limit = needle.chord_angle(distances) + settings.parallax_angle
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
