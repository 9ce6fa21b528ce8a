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
    """Constants of the search grid; half or twice the pitches find as many needles.

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
    pixels, depths = _interpolated(cameras, distances, side, cells)
    last = np.array([[each.camera.width, each.camera.height] for each in cameras])[:, None] - 1
    seen = (pixels >= GRID.border_px) & (pixels <= last - GRID.border_px)
    inside = seen.all(axis=(0, 2)) & (depths >= 0.0).all(axis=0)
    rows, columns, pixels = cells[inside, 0], cells[inside, 1:], pixels[:, inside]
    starts = np.searchsorted(rows, np.arange(len(distances) + 1))
    left, right = (GridView(seen.astype(np.float32), _boxes(seen, starts)) for seen in pixels)
    return SearchGrid(distances, starts, np.ascontiguousarray(columns), side, (left, right))


def _directions(columns: Indices, side: int) -> Array:
    """Return unit vectors in `rig`, shape (..., 3), of columns, shape (..., 2)."""
    tilts = GRID.angle_pitch * (columns - side // 2)
    tilt = np.linalg.norm(tilts, axis=-1, keepdims=True)
    return np.concatenate([np.sinc(tilt / math.pi) * tilts, np.cos(tilt)], axis=-1)


def _interpolated(
    cameras: tuple[RefractedCamera, RefractedCamera],
    distances: Array,
    side: int,
    cells: Indices,
) -> tuple[Array, Array]:
    """Return pixels and depths behind the window, shape (2, n, 2) and (2, n), of n cells."""
    step = GRID.lattice
    rows = -(-(len(distances) - 1) // step) + 1
    apart = distances[0] + step * GRID.row_pitch * np.arange(rows)
    columns = np.stack(np.meshgrid(*[np.arange(0, side, step)] * 2, indexing="ij"), axis=-1)
    points = apart[:, None, None, None] * _directions(columns, side)

    def at_cells(values: Array) -> Array:
        return np.asarray(map_coordinates(values, cells.T / step, order=1))

    pixels, depths = [], []
    for each in cameras:
        # A point behind the camera is put outside the image.
        projected = np.nan_to_num(each.project(points), nan=-1.0)
        pixels.append(np.stack([at_cells(projected[..., i]) for i in range(2)], axis=-1))
        depths.append(at_cells(each.camera.window.depth(points)))
    return np.stack(pixels), np.stack(depths)


def _boxes(pixels: Array, starts: Indices) -> Array:
    """Return the boxes of the rows; an empty row has an empty box."""
    boxes = np.full((len(starts) - 1, 4), [np.inf, np.inf, -np.inf, -np.inf])
    filled = starts[:-1] < starts[1:]
    if filled.any():
        boxes[filled, :2] = np.minimum.reduceat(pixels, starts[:-1][filled])
        boxes[filled, 2:] = np.maximum.reduceat(pixels, starts[:-1][filled])
    return boxes
