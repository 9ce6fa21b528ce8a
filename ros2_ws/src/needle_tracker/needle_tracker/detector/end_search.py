"""Search of the maps of one camera for ends that a shaft connects to the entry.

The search grid is polar about the entry, in the plane through z of `rig` that faces the window of
the camera. The needle passes through the entry point, and along an arc the chord turns only half as
fast as the needle, so a reachable needle runs outwards, with one cell in each row. The search
excludes everything outside the grid (sheath, hole, rim of the phantom).

The score of a path is the log-likelihood ratio of its cells, shaft against floor, plus that of an
end in its last cell; dynamic programming maximizes it.
"""

# Compiled functions take plain numbers, one by one.
# ruff: noqa: PLR0917

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled, inlined
from needle_tracker.detector.end_fit import FIT
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracker_parameters import StereoTrackerParameters

Array = NDArray[np.float64]
Map = NDArray[np.float32]
Cells = NDArray[np.int64]
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
    """Constants of the search grid.

    Attributes
    ----------
    row_pitch : float
        Distance between rows [m]: about the width of a thin needle.
    angle_pitch : float
        Angle between columns [rad]: 0.5 mm at the longest insertion.
    parallax_angle : float
        Angle by which a needle in front of or behind the plane appears displaced [rad].
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
    """Return the grid of one camera, starting outside the entry hole.

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


@dataclasses.dataclass(frozen=True)
class SearchSettings:
    """Constants of the path search; scores are natural logarithms of likelihood ratios.

    Attributes
    ----------
    candidates : int
        Ends of each view that are examined further.
    smooth_rows : int
        Rows over which the steps of the cells average out.
    shaft_prior, ends_prior : float
        Share of shaft pixels in the training images, and number of ends in the window of a cell:
        the network's probabilities divided by these are likelihood ratios.
    row_weight : float
        Weight of one row, less than 1 since neighbouring rows are correlated.
    row_limit : float
        Largest absolute score of one row.
    late_start : float
        Score of a path that begins away from the entry.
    path_limit : float
        Largest score of a shaft, so that a long line does not hide a short needle.
    """

    candidates: int = 10
    smooth_rows: int = 7
    shaft_prior: float = 0.04
    ends_prior: float = 1.5e-3
    row_weight: float = 0.25
    row_limit: float = 2.0
    late_start: float = -4.0
    path_limit: float = 6.0


SEARCH = SearchSettings()


@dataclasses.dataclass(frozen=True, eq=False)
class ShaftPath:
    """Path in one image from the entry to a candidate for the end of the needle.

    Attributes
    ----------
    pixels : ndarray, shape (n, 2)
        Pixels from the entry to the end, at the resolution of the grid [px].
    score : float
        Log-likelihood ratio of shaft and end.
    shaft : float
        Mean probability of shaft along the path.
    """

    pixels: Array
    score: float
    shaft: float

    @property
    def end(self) -> Array:
        """Return the last pixel, shape (2,)."""
        return np.asarray(self.pixels[-1])

    @property
    def direction(self) -> Array:
        """Return the unit vector towards the end, shape (2,)."""
        ahead = self.pixels[-1] - self.pixels[max(len(self.pixels) - 1 - SEARCH.smooth_rows, 0)]
        return np.asarray(ahead / np.linalg.norm(ahead))


def find_paths(
    grid: SearchGrid, shaft: Map, ends: Map, first_end: int, last_end: int
) -> list[ShaftPath]:
    """Return the paths with the largest scores and distinct ends, the best first.

    Parameters
    ----------
    grid : SearchGrid
        Grid of the camera.
    shaft, ends : ndarray of float32, shape (rows, columns)
        Maps at the cells of the first rows of the grid.
    first_end, last_end : int
        First and last row in which a path may end.
    """
    rows = min(last_end + 1, len(shaft))
    reachable = grid.reachable[:rows]
    pitch = grid.distances[:rows] * grid.angle_pitch
    # A path deviates from the radius by at most 45 deg, including the pre-bend.
    steps = np.maximum(1, np.ceil(grid.row_pitch / pitch)).astype(np.int64)
    # Ends within two rows count as one.
    apart = np.ceil(2.0 * grid.row_pitch / pitch).astype(np.int64)
    shaft_scores, end_scores = _scores(shaft[:rows], ends[:rows], reachable)
    cells, lengths, scores = _best_paths(
        shaft_scores,
        end_scores,
        steps,
        apart,
        max(first_end, 1),
        SEARCH.candidates,
        SEARCH.late_start,
        SEARCH.path_limit,
    )
    found = []
    for columns, length, score in zip(cells, lengths, scores, strict=True):
        if length:
            inside = np.arange(length), columns[:length]
            pixels = grid.pixels[inside].astype(np.float64)
            found.append(ShaftPath(pixels, float(score), float(shaft[inside].mean())))
    return found


def _scores(shaft: Map, ends: Map, reachable: Mask) -> tuple[Array, Array]:
    """Return the log-likelihood ratios of shaft in each cell, and of an end in it.

    A cell outside the image has no shaft score and no end.
    """
    chance, prior = shaft.astype(np.float64), SEARCH.shaft_prior
    with np.errstate(divide="ignore"):
        ratio = np.log(chance / (1.0 - chance)) - math.log(prior / (1.0 - prior))
    limited = SEARCH.row_weight * np.clip(ratio, -SEARCH.row_limit, SEARCH.row_limit)
    end = np.log(ends.astype(np.float64) / SEARCH.ends_prior + FIT.hidden_end)
    return np.where(reachable, limited, 0.0), np.where(reachable, end, -np.inf)


@compiled
def _best_paths(
    shaft_scores: Array,
    end_scores: Array,
    steps: Cells,
    apart: Cells,
    first_end: int,
    count: int,
    late_start: float,
    path_limit: float,
) -> tuple[Cells, Cells, Array]:
    """Return each path's columns, its number of rows (0: no path) and its score."""
    rows, columns = shaft_scores.shape
    total = _accumulated(shaft_scores, steps, late_start, path_limit)
    score = total + end_scores
    score[:first_end] = -np.inf
    # A candidate has the best score nearby, including along its own shaft.
    peaks = np.full((rows, columns), -np.inf)
    for i in range(first_end, rows):
        for j in range(columns):
            if score[i, j] > 0.0 and _is_peak(score, i, j, apart[i]):
                peaks[i, j] = score[i, j]
    cells = np.zeros((count, rows), np.int64)
    lengths = np.zeros(count, np.int64)
    scores = np.zeros(count)
    for n in range(count):
        end, column = divmod(int(peaks.argmax()), columns)
        if not peaks[end, column] > 0.0:
            break
        lengths[n], scores[n] = end + 1, peaks[end, column]
        peaks[end, column] = -np.inf
        _read_back(total, steps, end, column, cells[n])
    return cells, lengths, scores


@compiled
def _accumulated(scores: Array, steps: Cells, late_start: float, path_limit: float) -> Array:
    """Return the largest score of all paths to each cell.

    total[i, j] = min(score[i, j] + max(total[i - 1, j - step ... j + step], late), limit)
    """
    rows, columns = scores.shape
    total = np.zeros((rows, columns))
    for i in range(rows):
        for j in range(columns):
            if i:
                total[i, j] = late_start
                for k in range(max(j - steps[i], 0), min(j + steps[i] + 1, columns)):
                    total[i, j] = max(total[i, j], total[i - 1, k])
            total[i, j] = min(total[i, j] + scores[i, j], path_limit)
    return total


@compiled
def _read_back(total: Array, steps: Cells, end: int, column: int, cells: Cells) -> None:
    """Write the columns of the path that ends in a cell."""
    columns = total.shape[1]
    cells[end] = column
    for i in range(end, 0, -1):
        # Among equal totals, choose the straightest path.
        chosen, largest = column, total[i - 1, column]
        for away in range(1, steps[i] + 1):
            for k in (column - away, column + away):
                if 0 <= k < columns and total[i - 1, k] > largest:
                    chosen, largest = k, total[i - 1, k]
        column = chosen
        cells[i - 1] = column


@inlined
def _is_peak(score: Array, row: int, column: int, apart: int) -> bool:
    """Return whether a cell has the largest score nearby; of equal cells, the first counts."""
    rows, columns = score.shape
    own = score[row, column]
    for i in range(max(row - 2, 0), min(row + 2 + 1, rows)):
        for j in range(max(column - apart, 0), min(column + apart + 1, columns)):
            first = i < row or (i == row and j < column)
            if score[i, j] > own or (first and score[i, j] == own):
                return False
    return True
