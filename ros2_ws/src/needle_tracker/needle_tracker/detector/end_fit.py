"""Fit of the line and the end of the shaft to the maps of the network, near an expected end."""

# Compiled functions take plain numbers, one by one; numba's floor and ceil are floats.
# ruff: noqa: PLR0917, RUF046

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled, inlined

Array = NDArray[np.float64]
Map = NDArray[np.float32]


class EndFitSettings(NamedTuple):
    """Constants of the fit; lengths are in needle widths.

    Attributes
    ----------
    line_widths : float
        Length of shaft behind the end to which the line is fitted: short enough to be straight at
        the largest curvature of a needle.
    least_line_widths : float
        Least length of a line that has a direction.
    aside_widths : float
        Margin of the map on both sides of the line.
    largest_slope : float
        Tangent of the largest angle between the fitted line and the expected direction.
    systematic_widths : float
        Standard deviation of line and end in addition to that of the maps, caused by light and
        blur: from the errors in path-traced pairs. An error that both views share is
        `FilterSettings.end_sigma`.
    around_widths : float
        Half the length within which ends count as one, since a bevel blurs the end.
    hidden_end : float
        Probability that the network misses an existing end.
    """

    line_widths: float = 8.0
    least_line_widths: float = 2.0
    aside_widths: float = 2.0
    largest_slope: float = 0.15
    systematic_widths: float = 0.1
    around_widths: float = 3.0
    hidden_end: float = 0.05


FIT = EndFitSettings()
_PASSES = 2  # passes of the line fit; the second one is centred on the result of the first
_ONE_SIGMA = 0.5 * (1.0 + math.erf(math.sqrt(0.5)))  # share of a normal distribution below 1 sigma


@dataclasses.dataclass(frozen=True, eq=False)
class ImageEnd:
    """End of the needle in the image of one camera.

    Attributes
    ----------
    point : ndarray, shape (2,)
        End of the axis of the shaft [px].
    direction : ndarray, shape (2,)
        Unit vector along the shaft, towards the end.
    sigma_across, sigma_along : float
        Standard deviations of the end across and along the shaft [px].
    sigma_angle : float
        Standard deviation of the direction [rad].
    ends : float
        Expected number of ends near the point, from the network.
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
    shaft_length: float,
    along: float,
    across: float,
    width: float,
) -> ImageEnd | None:
    """Fit line and end.

    Parameters
    ----------
    shaft, ends : ndarray of float32, shape (height, width)
        Maps of a window.
    point, direction : ndarray, shape (2,)
        Expected end in the window [px], and unit vector along the shaft towards it.
    shaft_length : float
        Length of visible shaft up to the end [px].
    along, across : float
        Largest distance of the end from the point, along and across the direction [px].
    width : float
        Width of the needle [px].

    Returns
    -------
    ImageEnd or None
        None if the maps show no shaft there.
    """
    back = min(shaft_length, FIT.line_widths * width)
    if back < FIT.least_line_widths * width:
        return None
    point = np.ascontiguousarray(point, np.float64)
    direction = np.ascontiguousarray(direction, np.float64)
    offset, slope = _best_line(shaft, point, direction, back, across, width)
    end, spread = 0.0, along
    sigma_across = sigma_angle = certainty = 0.0
    for _ in range(_PASSES):
        length, offset, slope, sigma_across, sigma_angle, certainty = _fit_line(
            shaft, point, direction, offset, slope, end, back, width
        )
        if length < FIT.least_line_widths * width:
            return None
        end, spread = _end_on_line(ends, point, direction, offset, slope, along, width)
    norm, across_direction = math.hypot(1.0, slope), np.array([-direction[1], direction[0]])
    fitted = point + end * direction + (offset + slope * end) * across_direction
    return ImageEnd(
        fitted,
        (direction + slope * across_direction) / norm,
        math.hypot(sigma_across, FIT.systematic_widths * width),
        math.hypot(spread * norm, FIT.systematic_widths * width),
        math.hypot(sigma_angle, FIT.systematic_widths / FIT.line_widths),
        _ends_about(ends, fitted, width),
        certainty,
    )


def _ends_about(ends: Map, point: Array, width: float) -> float:
    """Return the expected number of ends within one needle width of a point."""
    half = max(int(math.ceil(width)), 2)
    column, row = np.rint(point).astype(int)
    rows = slice(max(row - half, 0), max(row + half + 1, 0))
    columns = slice(max(column - half, 0), max(column + half + 1, 0))
    return float(ends[rows, columns].sum())


@inlined
def _at(image: Map, x: float, y: float) -> float:
    """Return the value of a map by bilinear interpolation; 0 outside."""
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
def _best_line(
    shaft: Map, point: Array, direction: Array, back: float, across: float, width: float
) -> tuple[float, float]:
    """Return offset [px] and slope of the line with the largest sum of shaft probability."""
    best, offset, slope = -1.0, 0.0, 0.0
    pitch = 0.5 * width
    steps = int(math.ceil(across / pitch))
    # From one slope to the next, the far end of the line moves by at most the pitch.
    slopes = int(math.ceil(FIT.largest_slope * back / pitch))
    for j in range(-steps, steps + 1):
        for k in range(-slopes, slopes + 1):
            lean = FIT.largest_slope * k / slopes
            total = 0.0
            s = -back
            while s <= 0.0:
                total += _on_line(shaft, point, direction, s, j * pitch + lean * s)
                s += pitch
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
) -> tuple[float, float, float, float, float, float]:
    """Fit a line to the centre of the shaft, by weighted least squares.

    Return the length of the shaft [px], offset and slope, their standard deviations at the end, and
    the mean probability along the line.
    """
    count = int(back)
    positions, middles, weights = np.empty(count), np.empty(count), np.empty(count)
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
        positions[i], weights[i] = s, min(0.5 * mass / width, 1.0)
        middles[i] = centre
        if mass > 0.0:
            middles[i] += moment / mass
            breadth += weights[i] * (second / mass - (moment / mass) ** 2)
        certainty += _on_line(shaft, point, direction, s, centre)
    total = weights.sum()
    certainty /= count
    if total < 2.0:
        return total, offset, slope, 0.0, 0.0, certainty
    mean = (weights * positions).sum() / total
    middle = (weights * middles).sum() / total
    spread = (weights * (positions - mean) ** 2).sum() / total
    lean = (weights * (positions - mean) * (middles - middle)).sum() / (total * spread)
    residuals = middles - middle - lean * (positions - mean)
    variance = (weights * residuals * residuals).sum() / total
    # Disturbances of the centre are correlated over about the width of the needle.
    independent = max(total / width - 2.0, 1.0)
    # The variance of the probability across one shaft is width^2 / 12, with blurred edges up to
    # twice that. A broader distribution may be two lines, such as a needle beside its shadow.
    doubt = max(breadth / total - 2.0 * width * width / 12.0, 0.0)
    sigma = math.sqrt(doubt + variance / independent * (1.0 + (end - mean) ** 2 / spread))
    sigma_angle = math.sqrt(variance / independent / spread)
    return total, middle - lean * mean, lean, sigma, sigma_angle, certainty


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
    """Return the median of the position of the end along the line, and its standard deviation [px].

    The intensity of ends, summed across the line, is the density of the position. The share
    `hidden_end` is uniform over the window, so that a map without an end gives a wide spread.
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
    _keep_densest_interval(density, width)
    known = density.sum()
    flat = max(FIT.hidden_end, 1.0 - known) if known < FIT.hidden_end else FIT.hidden_end
    for i in range(count):
        density[i] = (density[i] / max(known, FIT.hidden_end)) * (
            1.0 - FIT.hidden_end
        ) + flat / count
    density /= density.sum()
    early, late = _quantile(density, 1.0 - _ONE_SIGMA), _quantile(density, _ONE_SIGMA)
    return _quantile(density, 0.5) - along, 0.5 * (late - early)


@compiled
def _keep_densest_interval(density: Array, width: float) -> None:
    """Set the density to 0 outside the interval with the largest sum.

    A wide window may show two ends, and their median would be at neither.
    """
    count = 2 * int(FIT.around_widths * width) + 1
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
    """Return the quantile of a density, in samples."""
    below = 0.0
    for i in range(len(density)):
        # A sample covers the pixel around it.
        if level <= below + density[i]:
            position: float = i - 0.5 + (level - below) / density[i]
            return position
        below += density[i]
    return len(density) - 0.5
