"""Search grid: the points in space that the needle can reach and both cameras see.

The needle passes through the entry point, and along an arc the chord turns only half as fast as the
needle. A reachable needle therefore runs outwards through spheres about the entry, with one cell on
each of them, in nearly the same direction. The grid excludes everything else (sheath, hole, rim of
the phantom).
"""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracker_parameters import StereoTrackerParameters

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclasses.dataclass(frozen=True)
class GridSettings:
    """Constants of the search grid; half the row pitch, or 0.7 deg, finds as many needles.

    Attributes
    ----------
    row_pitch : float
        Distance between the spheres [m]: about the width of a needle.
    angle_pitch : float
        Angle between neighbouring directions [rad]: 1.3 mm at the longest insertion.
    body_offset : float
        Largest distance of the shaft from the path of its tip [m], for a pre-bend of 10 deg over
        9 mm.
    border_px : int
        Width of the border of an image that is not searched [px].
    lattice : int
        Cells between two points that are projected; the pixels of others are interpolated.
    """

    row_pitch: float = 1.0e-3
    angle_pitch: float = math.radians(0.5)
    body_offset: float = 1.0e-3
    border_px: int = 6
    lattice: int = 4


GRID = GridSettings()


@dataclasses.dataclass(frozen=True, eq=False)
class GridView:
    """The cells in the image of one camera.

    Attributes
    ----------
    pixels : ndarray of float32, shape (n, 2)
        Pixels of the cells.
    boxes : ndarray, shape (rows, 4)
        First column and row, and last column and row, of the pixels of each row of cells [px].
    """

    pixels: NDArray[np.float32]
    boxes: Array


@dataclasses.dataclass(frozen=True, eq=False)
class SearchGrid:
    """Cells in rows of equal distance from the entry, ordered by row.

    Attributes
    ----------
    distances : ndarray, shape (rows,)
        Distance of each row from the entry [m].
    starts : ndarray of int, shape (rows + 1,)
        Index of the first cell of each row; last, the number of cells.
    columns : ndarray of int, shape (n, 2)
        Direction of each cell: its number of pitches along x and y, from the smallest ones.
    side : int
        Number of pitches along x and y.
    views : pair of GridView
        The cells in the left and the right image.
    """

    distances: Array
    starts: Indices
    columns: Indices
    side: int
    views: tuple[GridView, GridView]

    def row_of(self, distance: float) -> int:
        """Return the index of the row nearest to a distance from the entry [m]."""
        row = round((distance - float(self.distances[0])) / GRID.row_pitch)
        return min(max(row, 0), len(self.distances) - 1)

    def points(self, cells: Indices) -> Array:
        """Return the points of given cells in `rig` [m], shape (n, 3)."""
        rows = np.searchsorted(self.starts, cells, side="right") - 1
        return self.distances[rows, None] * _directions(self.columns[cells], self.side)


# The trackers of one rig share its grid.
@functools.lru_cache(maxsize=2)
def make_search_grid(
    cameras: tuple[RefractedCamera, RefractedCamera], needle: StereoTrackerParameters
) -> SearchGrid:
    """Return the grid of a rig, starting outside the entry hole.

    Parameters
    ----------
    cameras : pair of RefractedCamera
        Left and right.
    needle : StereoTrackerParameters
        Reach of the needle, and the entry hole.
    """
    distances = np.arange(needle.hole_clearance, needle.max_insertion, GRID.row_pitch)
    limit = needle.chord_angle(distances) + np.arctan2(GRID.body_offset, distances)
    # Close to the entry the hole tolerance would allow any angle.
    widest = min(float(limit[len(limit) // 2 :].max()), math.pi / 2)
    half = GRID.lattice * math.ceil(widest / GRID.angle_pitch / GRID.lattice)
    side = 2 * half + 1
    offsets = np.arange(-half, half + 1)
    tilts = GRID.angle_pitch * np.hypot(offsets[:, None], offsets)
    cells = np.argwhere(tilts <= np.minimum(limit, widest)[:, None, None])
    places = cells.T / GRID.lattice
    lattice = np.moveaxis(_lattice(cameras, distances, side), -1, 0)
    seen = np.stack([map_coordinates(values, places, order=1) for values in lattice], axis=-1)
    border, inside = GRID.border_px, (seen[:, 4:] >= 0.0).all(axis=1)
    for i, each in enumerate(cameras):
        for j, size in enumerate((each.camera.width, each.camera.height)):
            pixels = seen[:, 2 * i + j]
            inside &= (pixels >= border) & (pixels <= size - 1 - border)
    cells = cells[inside]
    starts = np.searchsorted(cells[:, 0], np.arange(len(distances) + 1))
    columns = np.ascontiguousarray(cells[:, 1:])
    left, right = (seen[inside, 2 * i : 2 * i + 2].astype(np.float32) for i in range(2))
    views = GridView(left, _boxes(left, starts)), GridView(right, _boxes(right, starts))
    return SearchGrid(distances, starts, columns, side, views)


def _directions(columns: Indices, side: int) -> Array:
    """Return unit vectors in `rig`, shape (..., 3), of columns, shape (..., 2)."""
    tilts = GRID.angle_pitch * (columns - side // 2)
    tilt = np.linalg.norm(tilts, axis=-1, keepdims=True)
    return np.concatenate([np.sinc(tilt / math.pi) * tilts, np.cos(tilt)], axis=-1)


def _lattice(
    cameras: tuple[RefractedCamera, RefractedCamera], distances: Array, side: int
) -> Array:
    """Return the pixels in both images and the depths behind both windows of some cells.

    Returns
    -------
    ndarray, shape (rows, columns, columns, 6)
        For every `GridSettings.lattice`-th cell in each direction.
    """
    step = GRID.lattice
    rows = -(-(len(distances) - 1) // step) + 1
    apart = distances[0] + step * GRID.row_pitch * np.arange(rows)
    columns = np.stack(np.meshgrid(*[np.arange(0, side, step)] * 2, indexing="ij"), axis=-1)
    points = apart[:, None, None, None] * _directions(columns, side)
    # A point behind the camera is put outside the image.
    pixels = [np.nan_to_num(each.project(points), nan=-1.0) for each in cameras]
    depths = [each.camera.window.depth(points)[..., None] for each in cameras]
    return np.concatenate([*pixels, *depths], axis=-1)


def _boxes(pixels: NDArray[np.float32], starts: Indices) -> Array:
    """Return the boxes of the rows; an empty row has an empty box."""
    boxes = np.full((len(starts) - 1, 4), [np.inf, np.inf, -np.inf, -np.inf])
    filled = starts[:-1] < starts[1:]
    if filled.any():
        boxes[filled, :2] = np.minimum.reduceat(pixels, starts[:-1][filled])
        boxes[filled, 2:] = np.maximum.reduceat(pixels, starts[:-1][filled])
    return boxes
