"""Fit the shaft's line and its end to the network's maps, about where the end is expected."""

# Compiled functions take plain numbers, one by one; numba's floor and ceil are floats.
# ruff: noqa: PLR0917, RUF046

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled, inlined

Array = NDArray[np.float64]
Map = NDArray[np.float32]

LINE_WIDTHS = 8.0
"""Shaft behind the end that the line is fitted to [needle widths]: short enough to be straight."""
ASIDE_WIDTHS = 2.0
"""Beside the line, map that is read [needle widths]."""
_MIN_LINE_WIDTHS = 2.0  # a shorter line has no direction [needle widths]
_SLOPES, _MAX_SLOPE = 7, 0.15  # directions tried about the expected one [-, tangent]
_PASSES = 2  # of the line's fit; each centres the window anew
# What light and blur leave in line and end beyond what the maps say [needle widths]: from errors in
# path-traced pairs. What a bevel does to the end of both views alike is `FilterSettings.end_sigma`.
_LINE_SYSTEMATIC = _END_SYSTEMATIC = 0.1
_ONE_SIGMA = 0.5 * (1.0 + math.erf(math.sqrt(0.5)))  # of a normal distribution, share below it
_AROUND_WIDTHS = 3.0  # to both sides, ends that may be one that a bevel blurs [needle widths]
_FLAT_SHARE = 0.05  # probability that the map of ends says nothing about the end


@dataclasses.dataclass(frozen=True, eq=False)
class ImageEnd:
    """The needle's end as one camera sees it.

    Attributes
    ----------
    point : ndarray, shape (2,)
        The end of the shaft's axis [px].
    direction : ndarray, shape (2,)
        Unit vector along the shaft, towards the end.
    sigma_across, sigma_along : float
        Standard deviations of the end across and along the shaft [px].
    sigma_angle : float
        Standard deviation of the direction [rad].
    ends : float
        Expected number of ends about the point, from the network.
    shaft : float
        Mean probability of shaft along the fitted line.
    """

    point: Array
    direction: Array
    sigma_across: float
    sigma_along: float
    sigma_angle: float
    ends: float
    shaft: float


def fit_end(
    shaft: Map,
    ends: Map,
    point: Array,
    direction: Array,
    *,
    behind: float,
    along: float,
    across: float,
    width: float,
) -> ImageEnd | None:
    """Fit line and end.

    Parameters
    ----------
    shaft, ends : ndarray of float32, shape (height, width)
        The network's maps of a window.
    point, direction : ndarray, shape (2,)
        Expected end in the window [px], and unit vector along the shaft towards it.
    behind : float
        Length of shaft behind the end [px].
    along, across : float
        How far from the point the end may be, along and across the direction [px].
    width : float
        Of the needle [px].

    Returns
    -------
    ImageEnd or None
        None if the maps show no shaft there.
    """
    back = min(behind, LINE_WIDTHS * width)
    if back < _MIN_LINE_WIDTHS * width:
        return None
    result = np.zeros(8)
    found = _fit(
        shaft,
        ends,
        np.ascontiguousarray(point, np.float64),
        np.ascontiguousarray(direction, np.float64),
        back,
        along,
        across,
        width,
        result,
    )
    if not found:
        return None
    u, v, d_u, d_v, sigma_across, sigma_along, sigma_angle, certainty = result.tolist()
    end = np.array([u, v])
    return ImageEnd(
        end,
        np.array([d_u, d_v]),
        math.hypot(sigma_across, _LINE_SYSTEMATIC * width),
        math.hypot(sigma_along, _END_SYSTEMATIC * width),
        math.hypot(sigma_angle, _LINE_SYSTEMATIC / LINE_WIDTHS),
        _ends_about(ends, end, width),
        certainty,
    )


def _ends_about(ends: Map, point: Array, width: float) -> float:
    """Return the expected number of ends within a needle's width of a point."""
    half = max(int(math.ceil(width)), 2)
    column, row = np.rint(point).astype(int)
    rows = slice(max(row - half, 0), max(row + half + 1, 0))
    columns = slice(max(column - half, 0), max(column + half + 1, 0))
    return float(ends[rows, columns].sum())


@inlined
def _at(image: Map, x: float, y: float) -> float:
    """Return a map at a place, by linear interpolation; 0 outside."""
    column, row = int(math.floor(x)), int(math.floor(y))
    if column < 0 or row < 0 or column + 1 >= image.shape[1] or row + 1 >= image.shape[0]:
        return 0.0
    a, b = x - column, y - row
    above = (1.0 - a) * image[row, column] + a * image[row, column + 1]
    below = (1.0 - a) * image[row + 1, column] + a * image[row + 1, column + 1]
    value: float = (1.0 - b) * above + b * below
    return value


@inlined
def _on_line(image: Map, point: Array, direction: Array, along: float, across: float) -> float:
    x = point[0] + along * direction[0] - across * direction[1]
    y = point[1] + along * direction[1] + across * direction[0]
    return _at(image, x, y)


@compiled
def _fit(
    shaft: Map,
    ends: Map,
    point: Array,
    direction: Array,
    back: float,
    along: float,
    across: float,
    width: float,
    result: Array,
) -> bool:
    """Write end (u, v), direction (u, v), sigmas across, along, of the angle, and the certainty."""
    offset, slope = _best_line(shaft, point, direction, back, across, width)
    end = 0.0
    line = np.empty(6)
    spread = along
    for _ in range(_PASSES):
        _fit_line(shaft, point, direction, offset, slope, end, back, width, line)
        if line[0] < _MIN_LINE_WIDTHS * width:
            return False
        offset, slope = line[1], line[2]
        end, spread = _end_on_line(ends, point, direction, offset, slope, along, width)
    norm = math.sqrt(1.0 + slope * slope)
    beside = offset + slope * end
    result[0] = point[0] + end * direction[0] - beside * direction[1]
    result[1] = point[1] + end * direction[1] + beside * direction[0]
    result[2] = (direction[0] - slope * direction[1]) / norm
    result[3] = (direction[1] + slope * direction[0]) / norm
    result[4], result[5], result[6], result[7] = line[3], spread * norm, line[4], line[5]
    return True


@compiled
def _best_line(
    shaft: Map, point: Array, direction: Array, back: float, across: float, width: float
) -> tuple[float, float]:
    """Return offset [px] and slope of the line that the most shaft lies on."""
    best, offset, slope = -1.0, 0.0, 0.0
    pitch = 0.5 * width
    steps = int(math.ceil(across / pitch))
    for j in range(-steps, steps + 1):
        for k in range(_SLOPES):
            lean = _MAX_SLOPE * (2.0 * k / (_SLOPES - 1) - 1.0)
            total = 0.0
            s = -back
            while s <= 0.0:
                total += _on_line(shaft, point, direction, s, j * pitch + lean * s)
                s += 0.5 * width
            if total > best:
                best, offset, slope = total, j * pitch, lean
    return offset, slope


@compiled
def _fit_line(
    shaft: Map,
    point: Array,
    direction: Array,
    offset: float,
    slope: float,
    end: float,
    back: float,
    width: float,
    line: Array,
) -> None:
    """Fit a line to the middles of the shaft, by weighted least squares.

    Writes the shaft's length [px], offset and slope, their standard deviations at the end, and the
    mean probability along the line.
    """
    count = int(back)
    places, middles, weights = np.empty(count), np.empty(count), np.empty(count)
    certainty = breadth = 0.0
    for i in range(count):
        s = end - i
        centre = offset + slope * s
        mass = moment = second = 0.0
        t = -width
        while t <= width:
            value = _on_line(shaft, point, direction, s, centre + t)
            mass += value
            moment += value * t
            second += value * t * t
            t += 0.5
        places[i], weights[i] = s, min(0.5 * mass / width, 1.0)
        middles[i] = centre
        if mass > 0.0:
            middles[i] += moment / mass
            breadth += weights[i] * (second / mass - (moment / mass) ** 2)
        certainty += _on_line(shaft, point, direction, s, centre)
    total = weights.sum()
    line[0], line[5] = total, certainty / count
    if total < 2.0:
        return
    mean = (weights * places).sum() / total
    middle = (weights * middles).sum() / total
    spread = max((weights * (places - mean) ** 2).sum() / total, 1e-9)
    lean = (weights * (places - mean) * (middles - middle)).sum() / (total * spread)
    residuals = middles - middle - lean * (places - mean)
    variance = (weights * residuals * residuals).sum() / total
    # What disturbs the middles does so over about a needle's width.
    independent = max(total / width - 2.0, 1.0)
    line[1], line[2] = middle - lean * mean, lean
    # The variance of one shaft's probability across it is width^2 / 12, of blurred edges a little
    # more. What is broader may be two, such as a needle beside its shadow.
    doubt = max(breadth / total - width * width / 6.0, 0.0)
    line[3] = math.sqrt(doubt + variance / independent * (1.0 + (end - mean) ** 2 / spread))
    line[4] = math.sqrt(variance / independent / spread)


@compiled
def _end_on_line(
    ends: Map,
    point: Array,
    direction: Array,
    offset: float,
    slope: float,
    along: float,
    width: float,
) -> tuple[float, float]:
    """Return the median of the end's place along the line, and its standard deviation [px].

    The network's intensity, summed across the line, is the density of the end's place. A small
    share is spread over the whole window, so that a map without an end says that it knows nothing.
    """
    count = 2 * int(along) + 1
    density = np.empty(count)
    for i in range(count):
        s = i - along
        centre = offset + slope * s
        total = 0.0
        t = -width
        while t <= width:
            total += _on_line(ends, point, direction, s, centre + t)
            t += 1.0
        density[i] = total
    _keep_about_the_most(density, width)
    known = density.sum()
    flat = max(_FLAT_SHARE, 1.0 - known) if known < _FLAT_SHARE else _FLAT_SHARE
    for i in range(count):
        density[i] = (density[i] / max(known, _FLAT_SHARE)) * (1.0 - _FLAT_SHARE) + flat / count
    density /= density.sum()
    early, late = _quantile(density, 1.0 - _ONE_SIGMA), _quantile(density, _ONE_SIGMA)
    return _quantile(density, 0.5) - along, 0.5 * (late - early)


@compiled
def _keep_about_the_most(density: Array, width: float) -> None:
    """Set the density to 0 but for a part of it that holds the most.

    A wide window may show other ends, too, and what is between two is none.
    """
    count = 2 * int(_AROUND_WIDTHS * width) + 1
    if len(density) <= count:
        return
    total = most = density[:count].sum()
    first = 0
    for i in range(1, len(density) - count + 1):
        total += density[i + count - 1] - density[i - 1]
        if total > most:
            first, most = i, total
    density[:first] = 0.0
    density[first + count :] = 0.0


@compiled
def _quantile(density: Array, level: float) -> float:
    """Return the place below which a share of the density lies, in samples."""
    below = 0.0
    for i in range(len(density)):
        # The density of a sample is that of the pixel about it.
        if level <= below + density[i]:
            place: float = i - 0.5 + (level - below) / density[i]
            return place
        below += density[i]
    return len(density) - 0.5
