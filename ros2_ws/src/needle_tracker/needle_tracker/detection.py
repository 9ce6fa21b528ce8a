"""Find the needle in one image: the best path outwards from the entry, and where it ends.

A centre-surround filter turns a thin dark line into a bright ridge. Dynamic programming over the
polar search grid finds the path with the largest sum of (ridge - threshold): evidence adds up
along the needle and is used up beyond its end, so that the maximum is at the tip, short gaps are
bridged, and nothing that is not joined to the entry is followed.
"""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_tracker.search_grid import SearchGrid

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Ridge = NDArray[np.float32]

_SLOPE = 1.0  # largest sideways step along a path, per step outwards (45 deg from the radius)
_IMPOSSIBLE = np.float32(-1e6)


@dataclasses.dataclass(frozen=True)
class DetectionSettings:
    """How a needle looks.

    Attributes
    ----------
    bright : bool
        Whether the needle is brighter than what is around it.
    needle_width_px : float
        Its width in the image.
    min_contrast : float
        Least contrast that counts [grey levels].
    noise_factor : float
        Ridge threshold in standard deviations of the ridge image's noise.
    min_length : float
        Shortest visible path that counts [m].
    """

    bright: bool = False
    needle_width_px: float = 4.6
    min_contrast: float = 10.0
    noise_factor: float = 5.0
    min_length: float = 2.0e-3


@dataclasses.dataclass(frozen=True)
class Window:
    """The part of a search grid that a prediction leaves.

    Attributes
    ----------
    first_row, last_row : int
        Rows to search, inclusive.
    start_column : int
        Column in which the path starts, in `first_row`; -1 for any.
    start_half_width : int
        Tolerance of `start_column`.
    lowest_column, highest_column : int
        Columns to search, inclusive.
    """

    first_row: int
    last_row: int
    start_column: int
    start_half_width: int
    lowest_column: int
    highest_column: int


@dataclasses.dataclass(frozen=True)
class Path:
    """A needle's path in one image, from the entry's side to the tip.

    Attributes
    ----------
    rows, columns : ndarray of int, shape (n,)
        Cells of the search grid.
    pixels : ndarray, shape (n, 2)
        The same in the image, good to about one cell [px].
    contrast : float
        Median ridge along the path [grey levels].
    """

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    pixels: Array
    contrast: float


def full_window(grid: SearchGrid, last_row: int | None = None) -> Window:
    """Return the window of the whole grid (up to `last_row`)."""
    rows = len(grid.distances) - 1
    last = rows if last_row is None else min(last_row, rows)
    return Window(0, last, -1, 0, 0, len(grid.angles) - 1)


def find_path(
    image: Image, grid: SearchGrid, window: Window, settings: DetectionSettings
) -> Path | None:
    """Return the needle's path within a window of the search grid.

    Parameters
    ----------
    image : ndarray of uint8, shape (height, width)
        The camera's image.
    grid : SearchGrid
        The camera's grid.
    window : Window
        Where to look.
    settings : DetectionSettings
        How the needle looks.

    Returns
    -------
    Path or None
        None where nothing in the window looks like a needle.
    """
    rows = slice(window.first_row, window.last_row + 1)
    columns = slice(window.lowest_column, window.highest_column + 1)
    reachable = grid.reachable[rows, columns]
    if reachable.shape[0] < 2 or not reachable.any():
        return None
    pixels = grid.pixels[rows, columns]
    ridge = _sampled_ridge(image, pixels, reachable, settings)
    noise = _noise(ridge[reachable])
    # The filter passes about half of a line's contrast.
    threshold = np.float32(max(settings.noise_factor * noise, 0.5 * settings.min_contrast))
    evidence = np.clip(ridge - threshold, -threshold, 2.0 * threshold)
    evidence = np.where(reachable, evidence, -threshold).astype(np.float32)
    steps = np.maximum(
        1,
        np.ceil(_SLOPE * grid.row_pitch / (grid.distances[rows] * grid.angle_pitch)).astype(int),
    )
    start = None
    if window.start_column >= 0:
        centre = window.start_column - window.lowest_column
        start = (centre - window.start_half_width, centre + window.start_half_width)
    cells = _best_path(evidence, steps, start)
    if cells is None:
        return None
    path_rows, path_columns = cells
    if len(path_rows) * grid.row_pitch < settings.min_length:
        return None
    contrast = float(np.median(ridge[path_rows, path_columns]))
    if contrast < threshold:
        return None
    return Path(
        path_rows + window.first_row,
        path_columns + window.lowest_column,
        pixels[path_rows, path_columns].astype(np.float64),
        contrast,
    )


def _sampled_ridge(
    image: Image, pixels: NDArray[np.float32], reachable: NDArray[np.bool_], s: DetectionSettings
) -> Ridge:
    """Return the ridge image at half resolution, sampled at the grid's pixels."""
    seen = pixels[reachable]
    margin = 8.0 * s.needle_width_px
    height, width = image.shape
    # Even corners, so that the half-size grid is the same for every window.
    x0 = 2 * int(max(0.0, float(seen[:, 0].min()) - margin) // 2)
    y0 = 2 * int(max(0.0, float(seen[:, 1].min()) - margin) // 2)
    x1 = int(min(width, float(seen[:, 0].max()) + margin + 1))
    y1 = int(min(height, float(seen[:, 1].max()) + margin + 1))
    half_size = ((x1 - x0) // 2, (y1 - y0) // 2)
    cut = image[y0 : y0 + 2 * half_size[1], x0 : x0 + 2 * half_size[0]]
    half = cv2.resize(cut, half_size, interpolation=cv2.INTER_AREA).astype(np.float32)
    near = cv2.GaussianBlur(half, (0, 0), 0.2 * s.needle_width_px)
    size = 2 * round(1.4 * s.needle_width_px) + 1
    around = cv2.blur(half, (size, size))
    ridge = near - around if s.bright else around - near
    # Pixel centres: the half-size pixel i covers the pixels 2 i and 2 i + 1.
    map_x = (pixels[..., 0] - np.float32(x0 + 0.5)) * np.float32(0.5)
    map_y = (pixels[..., 1] - np.float32(y0 + 0.5)) * np.float32(0.5)
    return np.asarray(
        cv2.remap(ridge, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    )


def _noise(values: NDArray[np.float32]) -> float:
    """Return a standard deviation that lines and spots do not spoil."""
    sample = values[:: max(1, len(values) // 4000)]
    return 1.4826 * float(np.median(np.abs(sample - np.median(sample))))


def _best_path(
    evidence: Ridge, steps: NDArray[np.int_], start: tuple[int, int] | None
) -> tuple[NDArray[np.intp], NDArray[np.intp]] | None:
    """Return rows and columns of the path with the most evidence, None if no sum is positive.

    The path starts in the first row (within `start`, if given), may end in any row and moves at
    most `steps[row]` columns sideways from a row to the next.
    """
    rows, columns = evidence.shape
    total = np.empty_like(evidence)
    total[0] = evidence[0]
    if start is not None:
        low, high = max(start[0], 0), min(start[1], columns - 1)
        allowed = np.zeros(columns, dtype=bool)
        allowed[low : high + 1] = True
        total[0, ~allowed] = _IMPOSSIBLE
    for row in range(1, rows):
        width = 2 * int(steps[row]) + 1
        best = cv2.dilate(
            total[row - 1 : row],
            np.ones((1, width), np.uint8),
            borderType=cv2.BORDER_CONSTANT,
            borderValue=float(_IMPOSSIBLE),
        )
        total[row] = best.reshape(-1) + evidence[row]
    end_row, column = (int(i) for i in np.unravel_index(int(np.argmax(total)), total.shape))
    if not total[end_row, column] > 0.0:
        return None
    path = np.empty(end_row + 1, dtype=np.intp)
    path[end_row] = column
    for row in range(end_row, 0, -1):
        step = int(steps[row])
        low = max(column - step, 0)
        before = total[row - 1, low : column + step + 1]
        # Of equals the straightest: a flat stretch must not pull the path to one side.
        ties = np.flatnonzero(before == before.max()) + low
        column = int(ties[np.argmin(np.abs(ties - column))])
        path[row - 1] = column
    return np.arange(end_row + 1, dtype=np.intp), path


def columns_within(grid: SearchGrid, distance: float, half_width: float) -> int:
    """Return how many columns a lateral width [m] covers at a distance from the entry [m]."""
    return math.ceil(half_width / (max(distance, 1e-3) * grid.angle_pitch))
