"""Find what may be the needle in one image: paths outwards from the entry, and where they end.

A centre-surround filter turns a thin line into a ridge. Dynamic programming over the polar search
grid finds the paths with the largest sum of (ridge - threshold): evidence adds up along the needle
and is used up beyond its end, so that the maximum is at the tip, short gaps are bridged, and
nothing that is not joined to the entry is followed. Several paths are returned, each in a direction
of its own: which one is the needle, two views decide together.
"""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled
from needle_tracker.image.best_paths import Ridge, Rows, best_paths
from needle_tracker.image.search_grid import SearchGrid

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_SLOPE = 1.0  # largest sideways step along a path, per step outwards (45 deg from the radius)
_CUT_ROWS = 6
_SHADOW_SHARE, _WHOLE = 0.65, 0.7
_NOISE_PITCH = 5
_OWN_WIDTH = 0.7e-3  # near its end a path has the cells so far to either side for itself [m]


@dataclasses.dataclass(frozen=True)
class DetectionSettings:
    """Looks of a needle.

    Attributes
    ----------
    bright : bool or None
        Whether the needle is brighter than what is around it; None where that is not known.
    needle_width_px : float
        Its width in the image.
    min_contrast : float
        Least contrast that counts [grey levels].
    noise_factor : float
        Ridge threshold in standard deviations of the ridge image's noise.
    min_length : float
        Shortest visible path that counts [m].
    min_coverage : float
        Least share of a path that looks like a needle.
    longest_gap : float
        Where so much of a path looks like none, it has ended [needle widths].
    """

    bright: bool | None = None
    needle_width_px: float = 4.6
    min_contrast: float = 10.0
    noise_factor: float = 5.0
    min_length: float = 2.0e-3
    min_coverage: float = 0.5
    longest_gap: float = math.inf


@dataclasses.dataclass(frozen=True)
class Path:
    """A path in one image, from the entry's side to where it may end.

    Attributes
    ----------
    rows, columns : ndarray of int, shape (n,)
        Cells of the search grid.
    pixels : ndarray, shape (n, 2)
        The same in the image, good to about one cell [px].
    contrast : float
        Median ridge along the path [grey levels].
    bright : bool
        Whether it is brighter than what is around it.
    coverage : float
        Share of it that looks like a needle.
    evidence : float
        Sum along it, in units of the threshold.
    """

    rows: Rows
    columns: Rows
    pixels: Array
    contrast: float
    bright: bool = False
    coverage: float = 1.0
    evidence: float = 0.0


def cut_path(path: Path, grid: SearchGrid, length: float) -> Path:
    """Return the part of a path up to a length from the entry [m], measured in the plane x = 0."""
    count = max(_cells_within(grid.distances, grid.angles, path.rows, path.columns, length), 2)
    return dataclasses.replace(
        path,
        rows=path.rows[:count],
        columns=path.columns[:count],
        pixels=path.pixels[:count],
    )


@compiled
def _cells_within(distances: Array, angles: Array, rows: Rows, columns: Rows, length: float) -> int:
    """Return how many cells of a path are no farther than a length along it."""
    run = before = y = z = 0.0
    # Over a few rows at once: cells make steps.
    for first in range(0, len(rows), _CUT_ROWS):
        distance, angle = distances[rows[first]], angles[columns[first]]
        to_y, to_z = distance * math.sin(angle), distance * math.cos(angle)
        before, run = run, run + math.hypot(to_y - y, to_z - z)
        y, z = to_y, to_z
        if run >= length:
            share = (length - before) / (run - before)
            return first - _CUT_ROWS + math.ceil(share * _CUT_ROWS)
    last = (len(rows) - 1) // _CUT_ROWS * _CUT_ROWS
    for i in range(last + 1, len(rows)):
        if run + distances[rows[i]] - distances[rows[last]] >= length:
            return i
    return len(rows)


def distinct(paths: list[Path]) -> list[Path]:
    """Return the paths without those that end where one before them does, the same way."""
    kept: list[Path] = []
    for path in paths:
        if not any(_alike(path, other) for other in kept):
            kept.append(path)
    return kept


def without_shadows(paths: list[Path]) -> list[Path]:
    """Return the paths without those that are much fainter than another one as whole as they are.

    A needle's shadow takes a share of the light only; the needle itself stands out more.
    """
    return [
        path
        for path in paths
        if not any(
            path.contrast < _SHADOW_SHARE * other.contrast
            and path.bright is other.bright
            and other.coverage >= max(_WHOLE, path.coverage - 0.1)
            for other in paths
        )
    ]


def _alike(one: Path, other: Path) -> bool:
    return (
        one.bright is other.bright
        and len(one.rows) > _CUT_ROWS < len(other.rows)
        and abs(len(one.rows) - len(other.rows)) <= 1
        and bool(np.abs(one.columns[-_CUT_ROWS:-1:2] - other.columns[-_CUT_ROWS:-1:2]).max() <= 1)
    )


def find_paths(
    image: Image,
    grid: SearchGrid,
    settings: DetectionSettings,
    *,
    ends: tuple[int, int] | None = None,
    count: int = 3,
) -> list[Path]:
    """Return paths that may be the needle.

    Parameters
    ----------
    image : ndarray of uint8, shape (height, width)
        The camera's image.
    grid : SearchGrid
        The camera's grid.
    settings : DetectionSettings
        How the needle looks.
    ends : pair of int, optional
        First and last row in which a path may end; any by default.
    count : int
        Most paths for either polarity.

    Returns
    -------
    list of Path
        Those with the most evidence first; empty where nothing looks like a needle.
    """
    first_end, last_end = (0, len(grid.distances) - 1) if ends is None else ends
    last_end = min(last_end, len(grid.distances) - 1)
    first_end = max(min(first_end, last_end), 1)
    rows = last_end + 1
    reachable = grid.reachable[:rows]
    if rows < 2 or not reachable.any():
        return []
    ridge, noise = _sampled_ridge(image, grid, rows, settings)
    # The filter passes about half of a line's contrast.
    threshold = max(settings.noise_factor * noise, 0.5 * settings.min_contrast)
    steps = np.maximum(
        1, np.ceil(_SLOPE * grid.row_pitch / (grid.distances[:rows] * grid.angle_pitch))
    ).astype(np.int64)
    widths = np.ceil(_OWN_WIDTH / (grid.distances[:rows] * grid.angle_pitch)).astype(np.int64)
    least = max(int(settings.min_length / grid.row_pitch), 2)
    longest_gap = settings.longest_gap * settings.needle_width_px / grid.row_pitch_px
    spent = np.float32(longest_gap * threshold)
    found = []
    for bright in (False, True) if settings.bright is None else (settings.bright,):
        sign = np.float32(1.0 if bright else -1.0)
        cells, lengths, sums = best_paths(
            ridge, reachable, steps, widths, sign, np.float32(threshold), spent, first_end, count
        )
        for path_columns, end_row, evidence in zip(cells, lengths, sums, strict=True):
            if end_row + 1 < least:
                continue
            path_rows = np.arange(end_row + 1)
            columns = path_columns[: end_row + 1]
            coverage, contrast = _appearance(ridge, columns, sign, np.float32(threshold))
            if coverage < settings.min_coverage or contrast < threshold:
                continue
            pixels = grid.pixels[path_rows, columns].astype(np.float64)
            found.append(
                Path(path_rows, columns, pixels, contrast, bright, coverage, float(evidence))
            )
    return sorted(found, key=lambda path: -path.evidence)


def _sampled_ridge(
    image: Image, grid: SearchGrid, rows: int, s: DetectionSettings
) -> tuple[Ridge, float]:
    """Return what is brighter than its surroundings, on the grid's cells, and its noise."""
    x0, y0, x1, y1 = grid.bounds(rows, 8.0 * s.needle_width_px, image.shape)
    half_size = ((x1 - x0) // 2, (y1 - y0) // 2)
    cut = image[y0 : y0 + 2 * half_size[1], x0 : x0 + 2 * half_size[0]]
    half = cv2.resize(cut, half_size, interpolation=cv2.INTER_AREA).astype(np.float32)
    near = cv2.GaussianBlur(half, (0, 0), max(0.2 * s.needle_width_px, 0.5))
    size = 2 * round(1.4 * s.needle_width_px) + 1
    ridge = np.subtract(near, cv2.blur(half, (size, size)), out=near)
    # Pixel centres: the half-size pixel i covers the pixels 2 i and 2 i + 1.
    sampled = _sampled(ridge, grid.pixels[:rows], grid.reachable[:rows], x0 + 0.5, y0 + 0.5)
    return sampled, _noise(ridge)


@compiled
def _sampled(
    ridge: Ridge, pixels: NDArray[np.float32], reachable: NDArray[np.bool_], x0: float, y0: float
) -> Ridge:
    rows, columns = reachable.shape
    height, width = ridge.shape
    values = np.zeros((rows, columns), np.float32)
    for i in range(rows):
        for j in range(columns):
            if not reachable[i, j]:
                continue
            x = min(max(0.5 * (pixels[i, j, 0] - x0), 0.0), width - 1.001)
            y = min(max(0.5 * (pixels[i, j, 1] - y0), 0.0), height - 1.001)
            column, row = int(x), int(y)
            a, b = x - column, y - row
            above = (1.0 - a) * ridge[row, column] + a * ridge[row, column + 1]
            below = (1.0 - a) * ridge[row + 1, column] + a * ridge[row + 1, column + 1]
            values[i, j] = (1.0 - b) * above + b * below
    return values


@compiled
def _noise(ridge: Ridge) -> float:
    """Return a standard deviation that lines and spots do not spoil."""
    sample = ridge[::_NOISE_PITCH, ::_NOISE_PITCH].copy().reshape(-1)
    return 1.4826 * float(np.median(np.abs(sample - np.median(sample))))


@compiled
def _appearance(
    ridge: Ridge, columns: Rows, sign: np.float32, threshold: np.float32
) -> tuple[float, float]:
    """Return which share of a path looks like a needle, and its median contrast."""
    values = np.empty(len(columns), np.float32)
    over = 0
    for i in range(len(columns)):
        values[i] = sign * ridge[i, columns[i]]
        over += values[i] > threshold
    return over / len(columns), float(np.median(values))


def of_one_polarity(paths: list[list[Path]]) -> list[list[Path]]:
    """Return the dark paths of both views, or the bright ones: those that stand out more.

    Beside a dark line there are bright ones, such as the gap between needle and shadow.
    """
    best = [
        sum(max((p.evidence for p in side if p.bright is bright), default=0.0) for side in paths)
        for bright in (False, True)
    ]
    bright = bool(best[1] > best[0])  # evidence may be a number of numpy's, and so would this
    return [[path for path in side if path.bright is bright] for side in paths]
