"""Grid of places where the needle can be in an image: polar, about the entry, of one camera.

The grid lies in the plane through the needle's axis (z of `rig`) that faces the camera's window.

The needle always passes the entry point, and along an arc of radius R the chord turns only half as
fast as the needle: in polar coordinates about the entry, any reachable needle runs outwards, row by
row. Outside of the grid (sheath, hole, the phantom's rim) nothing is looked at.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
from numpy.typing import NDArray

from needle_tracker.detector.reach import Reach
from needle_tracker.optics.refraction import RefractedCamera

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclasses.dataclass(frozen=True)
class SearchGrid:
    """The polar grid of one camera.

    Attributes
    ----------
    sideways : ndarray, shape (3,)
        Unit vector in `rig`: with z it spans the grid's plane.
    distances : ndarray, shape (rows,)
        Distance of each row from the entry [m].
    angles : ndarray, shape (columns,)
        Angle of each column to z, positive towards `sideways` [rad].
    pixels : ndarray, shape (rows, columns, 2), float32
        Where the camera sees the grid's points.
    reachable : ndarray, shape (rows, columns)
        Whether the needle can be there and the camera sees it.
    """

    sideways: Array
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


# Trackers of the same rig, one beside the other or one after the other, share theirs.
@functools.lru_cache(maxsize=4)
def make_search_grid(
    view: RefractedCamera,
    reach: Reach,
    *,
    first_distance: float,
    row_pitch: float = 0.5e-3,
    angle_pitch: float = math.radians(0.25),
    parallax_angle: float = math.radians(6.0),
    body_offset: float = 1.0e-3,
    border_px: int = 6,
) -> SearchGrid:
    """Lay the grid out for one camera.

    Parameters
    ----------
    view : RefractedCamera
        The camera.
    reach : Reach
        What the needle can do.
    first_distance : float
        Rows start here, beyond the entry hole [m].
    row_pitch : float
        Distance between rows [m].
    angle_pitch : float
        Angle between columns [rad].
    parallax_angle : float
        Room for needles before and behind the plane, which appear displaced sideways [rad].
    body_offset : float
        How far the shaft lies beside the tip's path, with a pre-bend of 10 deg over 9 mm [m].
    border_px : int
        Width of the image's border that is not searched [px].

    Returns
    -------
    SearchGrid
        The grid.
    """
    distances = np.arange(first_distance, reach.length, row_pitch)
    limit = reach.chord_angle(distances) + np.arctan2(body_offset, distances) + parallax_angle
    # Close to the entry the hole's tolerance would ask for any angle.
    widest = min(float(limit[len(limit) // 4 :].max()), math.radians(75.0))
    half = math.ceil(widest / angle_pitch)
    angles = angle_pitch * np.arange(-half, half + 1)
    directions = np.sin(angles)[:, None] * view.sideways + np.cos(angles)[:, None] * [0.0, 0.0, 1.0]
    points = distances[:, None, None] * directions
    pixels = view.project(points)
    camera = view.camera
    with np.errstate(invalid="ignore"):
        inside = (
            (pixels[..., 0] >= border_px)
            & (pixels[..., 0] <= camera.width - 1 - border_px)
            & (pixels[..., 1] >= border_px)
            & (pixels[..., 1] <= camera.height - 1 - border_px)
        )
    reachable = inside & (np.abs(angles)[None, :] <= limit[:, None])
    pixels32 = np.nan_to_num(pixels, nan=-1e3).astype(np.float32)
    return SearchGrid(
        view.sideways,
        np.asarray(distances, dtype=np.float64),
        np.asarray(angles, dtype=np.float64),
        pixels32,
        reachable,
    )
